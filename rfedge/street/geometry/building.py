"""The houses: facades along the street and across its ends, roofs, gables and chimneys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rfedge.street.geometry.facade import Look, facade
from rfedge.street.geometry.layout import BEYOND_M, Layout, Plot
from rfedge.street.geometry.material import Material
from rfedge.street.geometry.mesh import F64, Label, Mesh, placed
from rfedge.street.geometry.solids import Stuff, boxes, quads
from rfedge.street.geometry.wall_texture import WALL_TILE_M, bricks, plaster, roof_tiles, stone
from rfedge.street.geometry.window_texture import rooms
from rfedge.street.geometry.world import Part

__all__ = ["buildings"]

BRICKS = (
    ((150, 72, 52), (112, 50, 40), (158, 150, 140)),
    ((166, 128, 92), (128, 96, 70), (176, 168, 156)),
    ((96, 64, 56), (70, 46, 42), (120, 114, 108)),
)
"""Lightest and darkest brick, mortar; 0..255 as painted."""
PLASTERS = ((214, 198, 160), (178, 182, 184), (200, 150, 118), (170, 178, 158), (206, 188, 184))
FRAMES = ((0.66, 0.65, 0.61), (0.10, 0.08, 0.06), (0.13, 0.17, 0.15))
DOORS = ((0.16, 0.06, 0.03), (0.03, 0.09, 0.06), (0.05, 0.07, 0.16), (0.22, 0.04, 0.04))
WALLS = len(BRICKS) + len(PLASTERS) + 1
ROOF = Stuff("roof", Label.BUILDING, 2.0)
HOUSE_DEPTH_M = 12.0


def buildings(layout: Layout, rng: np.random.Generator) -> Part:
    """Return all houses; the looks of each follow from its plot's style."""
    meshes = []
    for plot in layout.plots:
        meshes += _house(plot, plot.world_from_facade)
    for plot, world_from_facade in _across_the_ends(layout, rng):
        meshes += _house(plot, world_from_facade)
    return Part(tuple(meshes), _materials(rng))


def _house(plot: Plot, world_from_facade: F64) -> list[Mesh]:
    rng = np.random.default_rng(plot.style)
    look = Look(
        wall=Stuff(f"wall{rng.integers(0, WALLS)}", Label.BUILDING, WALL_TILE_M),
        frame=Stuff(f"frame{rng.integers(0, len(FRAMES))}", Label.BUILDING),
        door=Stuff(f"door{rng.integers(0, len(DOORS))}", Label.BUILDING),
    )
    meshes = [*facade(plot, look, rng), *_shell(plot, look), *_roof(plot, rng)]
    return [placed(mesh, world_from_facade) for mesh in meshes]


def _shell(plot: Plot, look: Look) -> list[Mesh]:
    """The gable walls, which show where a neighbour is lower or away, and the back."""
    w, h, d = plot.width_m, plot.height_m, HOUSE_DEPTH_M
    corners = np.array(
        [
            [(0, 0, -d), (0, 0, 0), (0, h, 0), (0, h, -d)],
            [(w, 0, 0), (w, 0, -d), (w, h, -d), (w, h, 0)],
            [(w, 0, -d), (0, 0, -d), (0, h, -d), (w, h, -d)],
        ]
    )
    along = corners[..., [2]] + corners[..., [0]]
    uv = np.concatenate([along, -corners[..., [1]]], axis=2) / look.wall.tile_m
    gables = np.array([[(x, h, 0), (x, h + 3, -d / 2), (x, h, -d), (x, h, -d)] for x in (0, w)])
    gable_uv = np.stack([gables[..., 2], -gables[..., 1]], axis=2) / look.wall.tile_m
    return [quads(look.wall, corners, uv), quads(look.wall, gables, gable_uv)]


def _roof(plot: Plot, rng: np.random.Generator) -> list[Mesh]:
    w, h, d = plot.width_m, plot.height_m, HOUSE_DEPTH_M
    slope = np.hypot(3.0, d / 2) / ROOF.tile_m
    front = [(0, h, 0.35), (w, h, 0.35), (w, h + 3, -d / 2), (0, h + 3, -d / 2)]
    back = [(w, h, -d), (0, h, -d), (0, h + 3, -d / 2), (w, h + 3, -d / 2)]
    uv = [[(0, slope), (w / ROOF.tile_m, slope), (w / ROOF.tile_m, 0), (0, 0)]] * 2
    across = rng.uniform(1.0, w - 1.6)
    chimney = boxes(
        Stuff("wall0", Label.BUILDING, WALL_TILE_M),
        (across, h + 1.0, -d / 2 + 0.8),
        (across + 0.6, h + 4.2, -d / 2 + 1.5),
    )
    return [quads(ROOF, [front, back], uv), chimney]


def _across_the_ends(layout: Layout, rng: np.random.Generator) -> list[tuple[Plot, F64]]:
    """Houses that close the view where the road goes on: one row at each end."""
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
