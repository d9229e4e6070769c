"""Make the houses: facades along the street and across its ends, roofs, gables and chimneys.

Wall textures are brick in running bond, plaster with rain streaks, cut stone, and roof tiles.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from streetgen.classes import Label
from streetgen.geometry.facade import BuildingStyle, facade, rooms
from streetgen.geometry.grain import enlarged, fractal, texture, tinted
from streetgen.geometry.layout import BEYOND_M, Layout, Plot
from streetgen.geometry.mesh import F32, F64, Colour, Material, Mesh, Texture, placed
from streetgen.geometry.solids import Surface, boxes, quads
from streetgen.geometry.world import StreetPart

WALL_TILE_M = 4.0
SHAPE = (1024, 1024)
"""Size of a wall's texture, px, at 256 px a metre: a brick is 64 by 16 px, 25 by 6.2 cm."""
BRICK_PX, COURSE_PX = 64, 16


def bricks(light: Colour, dark: Colour, mortar: Colour, rng: np.random.Generator) -> Texture:
    """Return a brick wall whose bricks are between two colours."""
    painted = tinted(SHAPE, mortar) * (1 + 0.08 * fractal(SHAPE, 2.6, rng)[..., None])
    for course in range(SHAPE[0] // COURSE_PX):
        shift_px = (course % 2) * BRICK_PX // 2
        rows = slice(course * COURSE_PX + 2, (course + 1) * COURSE_PX - 2)
        for i in range(SHAPE[1] // BRICK_PX):
            share, shade = rng.uniform((0, 0.8), (1, 1.15))
            colour = (np.array(light) + (np.array(dark) - np.array(light)) * share) * shade
            start = i * BRICK_PX + shift_px
            painted[rows, np.arange(start + 2, start + BRICK_PX - 2) % SHAPE[1]] = colour
    painted *= 1 + 0.09 * fractal(SHAPE, 2.4, rng)[..., None]
    painted *= 1 + 0.07 * rng.standard_normal((*SHAPE, 1), dtype=np.float32)
    return texture(painted)


def plaster(colour: Colour, rng: np.random.Generator) -> Texture:
    """Return rendered plaster, streaked by rain and cracked in places."""
    return texture(_plaster(colour, rng))


def stone(colour: Colour, rng: np.random.Generator) -> Texture:
    """Return ashlar: blocks of 1 by 0.5 m in running bond."""
    painted = _plaster(colour, rng)
    for course in range(8):
        top = course * 128
        painted[top : top + 5] *= 0.6
        for start in range(0, 1024, 256):
            left = (start + (course % 2) * 128) % 1024
            painted[top : top + 128, left : left + 5] *= 0.6
    return texture(painted)


def roof_tiles(rng: np.random.Generator) -> Texture:
    """Return courses of clay tiles."""
    painted = tinted((512, 512), (120, 60, 46))
    painted *= 1 + 0.1 * fractal((512, 512), 2.2, rng)[..., None]
    for course in range(0, 512, 32):
        painted[course : course + 4] *= 0.5
    return texture(painted)


def _plaster(colour: Colour, rng: np.random.Generator) -> F32:
    painted = tinted(SHAPE, colour) * (1 + 0.05 * fractal(SHAPE, 2.6, rng)[..., None])
    painted *= 1 + 0.035 * rng.standard_normal((*SHAPE, 1), dtype=np.float32)
    streaks = enlarged(rng.standard_normal((4, 256), dtype=np.float32), SHAPE)
    soiled = np.clip(fractal(SHAPE, 3.0, rng), 0, 2)
    painted *= 1 - 0.04 * (soiled * (1 + np.clip(streaks, -1, 2)))[..., None]
    dark = tuple(0.65 * value for value in colour)
    for _ in range(10):
        steps = rng.normal(0, 9, (30, 2)) + np.array([3, 5])
        line = (rng.uniform(0, 1024, 2) + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(painted, [line], False, dark, 1, cv2.LINE_AA)
    return painted


BRICKS = (
    ((150, 72, 52), (112, 50, 40), (158, 150, 140)),
    ((166, 128, 92), (128, 96, 70), (176, 168, 156)),
    ((96, 64, 56), (70, 46, 42), (120, 114, 108)),
)
"""sRGB colours 0..255 of the lightest brick, the darkest brick and the mortar."""
PLASTERS = ((214, 198, 160), (178, 182, 184), (200, 150, 118), (170, 178, 158), (206, 188, 184))
FRAMES = ((0.66, 0.65, 0.61), (0.10, 0.08, 0.06), (0.13, 0.17, 0.15))
DOORS = ((0.16, 0.06, 0.03), (0.03, 0.09, 0.06), (0.05, 0.07, 0.16), (0.22, 0.04, 0.04))
WALLS = len(BRICKS) + len(PLASTERS) + 1
ROOF = Surface("roof", Label.BUILDING, 2.0)
HOUSE_DEPTH_M = 12.0


def buildings(layout: Layout, rng: np.random.Generator) -> StreetPart:
    """Return all houses; the looks of each follow from its plot's style."""
    meshes = []
    for plot in layout.plots:
        meshes += _house(plot, plot.world_from_facade)
    for plot, world_from_facade in _across_the_ends(layout, rng):
        meshes += _house(plot, world_from_facade)
    return StreetPart(tuple(meshes), _materials(rng))


def _house(plot: Plot, world_from_facade: F64) -> list[Mesh]:
    rng = np.random.default_rng(plot.style)
    style = BuildingStyle(
        wall=Surface(f"wall{rng.integers(0, WALLS)}", Label.BUILDING, WALL_TILE_M),
        frame=Surface(f"frame{rng.integers(0, len(FRAMES))}", Label.BUILDING),
        door=Surface(f"door{rng.integers(0, len(DOORS))}", Label.BUILDING),
    )
    meshes = [*facade(plot, style, rng), *_shell(plot, style), *_roof(plot, rng)]
    return [placed(mesh, world_from_facade) for mesh in meshes]


def _shell(plot: Plot, style: BuildingStyle) -> list[Mesh]:
    """Return the back and the gable walls, which show where a neighbour is lower or missing."""
    w, h, d = plot.width_m, plot.height_m, HOUSE_DEPTH_M
    corners = np.array(
        [
            [(0, 0, -d), (0, 0, 0), (0, h, 0), (0, h, -d)],
            [(w, 0, 0), (w, 0, -d), (w, h, -d), (w, h, 0)],
            [(w, 0, -d), (0, 0, -d), (0, h, -d), (w, h, -d)],
        ]
    )
    along = corners[..., [2]] + corners[..., [0]]
    uv = np.concatenate([along, -corners[..., [1]]], axis=2) / style.wall.tile_m
    gables = np.array([[(x, h, 0), (x, h + 3, -d / 2), (x, h, -d), (x, h, -d)] for x in (0, w)])
    gable_uv = np.stack([gables[..., 2], -gables[..., 1]], axis=2) / style.wall.tile_m
    return [quads(style.wall, corners, uv), quads(style.wall, gables, gable_uv)]


def _roof(plot: Plot, rng: np.random.Generator) -> list[Mesh]:
    w, h, d = plot.width_m, plot.height_m, HOUSE_DEPTH_M
    slope = np.hypot(3.0, d / 2) / ROOF.tile_m
    front = [(0, h, 0.35), (w, h, 0.35), (w, h + 3, -d / 2), (0, h + 3, -d / 2)]
    back = [(w, h, -d), (0, h, -d), (0, h + 3, -d / 2), (w, h + 3, -d / 2)]
    uv = [[(0, slope), (w / ROOF.tile_m, slope), (w / ROOF.tile_m, 0), (0, 0)]] * 2
    across = rng.uniform(1.0, w - 1.6)
    chimney = boxes(
        Surface("wall0", Label.BUILDING, WALL_TILE_M),
        (across, h + 1.0, -d / 2 + 0.8),
        (across + 0.6, h + 4.2, -d / 2 + 1.5),
    )
    return [quads(ROOF, [front, back], uv), chimney]


def _across_the_ends(layout: Layout, rng: np.random.Generator) -> list[tuple[Plot, F64]]:
    """Return a row of houses for each end, which closes the view where the road goes on."""
    found = []
    for sign in (1, -1):
        outwards = np.array([-float(sign), 0.0, 0.0])
        along = np.cross((0.0, 0.0, 1.0), outwards)
        x = sign * (layout.end_m + BEYOND_M - 2.0)
        start = -45.0
        while start < 45.0:
            width = rng.uniform(10.0, 16.0)
            plot = replace(
                layout.plots[0],
                start_m=0.0,
                end_m=width,
                floors=int(rng.integers(3, 7)),
                style=int(rng.integers(0, 2**31)),
            )
            matrix = np.eye(4)
            corner = start * along + (x, 0.0, 0.0)
            matrix[:3] = np.stack([along, (0.0, 0.0, 1.0), outwards, corner], axis=1)
            found.append((plot, matrix))
            start += width
    return found


def _materials(rng: np.random.Generator) -> tuple[Material, ...]:
    walls = [bricks(*colours, rng) for colours in BRICKS]
    walls += [plaster(colour, rng) for colour in PLASTERS]
    walls.append(stone((196, 188, 172), rng))
    return (
        *(Material(f"wall{i}", painted) for i, painted in enumerate(walls)),
        *(Material(f"frame{i}", colour, roughness=0.5) for i, colour in enumerate(FRAMES)),
        *(Material(f"door{i}", colour, gloss=True) for i, colour in enumerate(DOORS)),
        Material("roof", roof_tiles(rng)),
        Material("trim", (0.5, 0.48, 0.43)),
        Material("metal", (0.05, 0.055, 0.055), roughness=0.45, metallic=0.3),
        Material("glass", rooms(rng), gloss=True),
    )
