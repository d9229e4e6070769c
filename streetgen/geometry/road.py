"""Make the ground: road, kerbs, pavements, markings and manholes, with their textures.

Asphalt has cracks and patches, pavements are slabs, and paint is worn.
"""

from __future__ import annotations

import cv2
import numpy as np

from streetgen.classes import Label
from streetgen.geometry.grain import fractal, speckle, texture, tinted
from streetgen.geometry.layout import (
    BAY_LENGTH_M,
    BEYOND_M,
    CROSSING_M,
    KERB_M,
    PAVEMENT_UP_M,
    SIDES,
    Layout,
)
from streetgen.geometry.mesh import F32, F64, Material, Mesh, Texture
from streetgen.geometry.solids import Surface, boxes, disc, quads
from streetgen.geometry.world import StreetPart

ASPHALT_TILE_M = 8.0
SLAB_TILE_M = 4.0
CRACKS, PATCHES, STAINS = 14, 9, 40


def asphalt(rng: np.random.Generator) -> Texture:
    """Return 8 m by 8 m of road at 256 px a metre."""
    shape = (2048, 2048)
    painted = tinted(shape, (78, 78, 80))
    painted *= 1 + 0.06 * fractal(shape, 2.6, rng)[..., None]
    painted += 11 * speckle(shape, 1.2, rng)[..., None] + 4 * fractal(shape, 1.2, rng)[..., None]
    for _ in range(CRACKS):
        width_px = int(rng.integers(1, 4))
        line = _wander(rng, 2048, steps=60, step_px=14.0)
        cv2.polylines(painted, [line], False, (38, 38, 38), width_px, cv2.LINE_AA)
    for _ in range(PATCHES):
        _patch(painted, rng)
    for _ in range(STAINS):
        middle = tuple(int(v) for v in rng.integers(0, 2048, 2))
        axes = (int(rng.integers(4, 40)), int(rng.integers(4, 26)))
        grey = (rng.uniform(48, 72),) * 3
        cv2.ellipse(painted, middle, axes, rng.uniform(0, 180), 0, 360, grey, -1, cv2.LINE_AA)
    return texture(painted)


def slabs(rng: np.random.Generator) -> Texture:
    """Return 4 m by 4 m of pavement, slabs of half a metre, at 256 px a metre."""
    shape, side = (1024, 1024), 128
    painted = tinted(shape, (140, 136, 128))
    painted *= 1 + 0.07 * fractal(shape, 2.6, rng)[..., None]
    painted *= 1 + 0.05 * rng.standard_normal((*shape, 1), dtype=np.float32)
    shades = rng.uniform(0.84, 1.12, (8, 8)).astype(np.float32)
    painted *= shades.repeat(side, axis=0).repeat(side, axis=1)[..., None]
    for joint in range(0, 1024, side):
        painted[joint : joint + 4] *= 0.5
        painted[:, joint : joint + 4] *= 0.5
    for _ in range(220):
        middle = tuple(int(v) for v in rng.integers(0, 1024, 2))
        grey = (rng.uniform(70, 110),) * 3
        cv2.circle(painted, middle, int(rng.integers(2, 6)), grey, -1, cv2.LINE_AA)
    return texture(painted)


def paint(rng: np.random.Generator) -> Texture:
    """Return road paint that traffic has worn through in places, 2 m by 2 m."""
    shape = (512, 512)
    painted = tinted(shape, (215, 215, 208)) * (1 + 0.06 * fractal(shape, 2.6, rng)[..., None])
    worn = fractal(shape, 1.8, rng) + 0.5 * rng.standard_normal(shape, dtype=np.float32)
    painted[worn > 1.5] = (90, 90, 92)
    return texture(painted)


def _patch(painted: F32, rng: np.random.Generator) -> None:
    x, y = (int(v) for v in rng.integers(0, 1540, 2))
    width, height = (int(v) for v in rng.integers(120, 500, 2))
    painted[y : y + height, x : x + width] *= rng.uniform(0.72, 1.12)
    cv2.rectangle(painted, (x, y), (x + width, y + height), (42, 42, 42), 3)


def _wander(rng: np.random.Generator, side_px: int, steps: int, step_px: float) -> np.ndarray:
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, steps))
    moves = step_px * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.asarray(rng.uniform(0, side_px, 2) + np.cumsum(moves, axis=0)).astype(np.int32)


ASPHALT = Surface("asphalt", Label.ROAD, ASPHALT_TILE_M)
SLABS = Surface("slabs", Label.PAVEMENT, SLAB_TILE_M)
KERB = Surface("kerb", Label.PAVEMENT)
PAINT = Surface("paint", Label.MARKING, 2.0)
IRON = Surface("iron", Label.ROAD)
BAY_LINE_M, ZEBRA_HALF_M = 4.2, 6.0
PAINT_UP_M = 0.004
"""Height of the markings above the road, less than any depth map resolves at 10 m."""
PAVEMENT_TO_M = 30.0


def road(layout: Layout, rng: np.random.Generator) -> StreetPart:
    """Return the ground of the street."""
    start, end = layout.start_m - BEYOND_M, layout.end_m + BEYOND_M
    half = layout.road_half_m
    meshes = [_flat(ASPHALT, np.array([[start, -half, end, half]]), 0.0)]
    meshes += [mesh for side in SIDES for mesh in _edge(side, start, end, half)]
    meshes += _markings(layout)
    meshes += _manholes(layout, rng)
    return StreetPart(
        tuple(meshes),
        (
            Material("asphalt", asphalt(rng), roughness=0.8),
            Material("slabs", slabs(rng)),
            Material("kerb", (0.42, 0.41, 0.39)),
            Material("paint", paint(rng)),
            Material("iron", (0.06, 0.06, 0.065), roughness=0.45, metallic=0.4),
        ),
    )


def _edge(side: int, start: float, end: float, half_m: float) -> list[Mesh]:
    """Return kerb stones of a metre with joints between them, and the pavement behind."""
    stones = np.arange(start, end, 1.0)
    inner, outer = sorted((side * half_m, side * (half_m + KERB_M)))
    ones = np.ones_like(stones)
    low = np.stack([stones + 0.006, inner * ones, -0.1 * ones], axis=1)
    high = np.stack([stones + 0.994, outer * ones, PAVEMENT_UP_M * ones], axis=1)
    near, far = sorted((side * (half_m + KERB_M), side * PAVEMENT_TO_M))
    pavement = np.array([[start, near, end, far]])
    return [boxes(KERB, low, high), _flat(SLABS, pavement, PAVEMENT_UP_M)]


def _markings(layout: Layout) -> list[Mesh]:
    start, end, wider_m = layout.start_m, layout.end_m, layout.geometry.wider_m
    dashes = np.arange(start, end, 6.0)
    kept = dashes[[not layout.at_crossing(x + 1.5, 2.0) for x in dashes]]
    areas = [_strips(kept, 3.0, -0.07, 0.07)]
    for side in SIDES:
        areas += _bay_lines(layout, side)
    for crossing in layout.crossings_x_m:
        across = np.arange(-ZEBRA_HALF_M - wider_m, ZEBRA_HALF_M + wider_m, 1.0)
        left = np.full_like(across, crossing - CROSSING_M / 2)
        areas.append(np.stack([left, across + 0.25, left + CROSSING_M, across + 0.75], axis=1))
    return [_flat(PAINT, np.concatenate(areas), PAINT_UP_M)]


def _bay_lines(layout: Layout, side: int) -> list[F64]:
    """Return a line along the bays of a side, which crossings interrupt, and lines between them."""
    middles = np.array([bay.x_m for bay in layout.bays if bay.side == side])
    starts = middles - BAY_LENGTH_M / 2
    edges = np.unique(np.round(np.concatenate([starts, starts + BAY_LENGTH_M]), 3))
    line = side * (BAY_LINE_M + layout.geometry.wider_m)
    low, high = sorted((line, side * layout.road_half_m))
    return [
        _strips(starts, BAY_LENGTH_M, line - 0.06, line + 0.06),
        _strips(edges - 0.05, 0.1, low, high),
    ]


def _manholes(layout: Layout, rng: np.random.Generator) -> list[Mesh]:
    count = max(int((layout.end_m - layout.start_m) / 25), 1)
    x = rng.uniform(layout.start_m, layout.end_m, count)
    y = rng.uniform(-3.0, 3.0, count)
    centres = np.stack([x, y, np.full(count, 0.006)], axis=1)
    return [disc(IRON, centre, (0, 0, 1), 0.33) for centre in centres]


def _strips(start: F64, length: float, low: float, high: float) -> F64:
    ones = np.ones_like(start)
    return np.stack([start, low * ones, start + length, high * ones], axis=1)


def _flat(surface: Surface, areas: F64, z_m: float) -> Mesh:
    """Return rectangles (x0, y0, x1, y1) [N, 4] that look up."""
    x0, y0, x1, y1 = areas.T
    corners = np.stack(
        [np.stack([x, y], axis=1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1
    )
    up = np.full((*corners.shape[:2], 1), z_m)
    uv = corners * (1, -1) / surface.tile_m
    return quads(surface, np.concatenate([corners, up], axis=2), uv)
