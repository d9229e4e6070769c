"""Make a facade: ground floor with shop or dwelling, windows above, and parts that protrude.

Everything is in the facade's own axes (``Plot.world_from_facade``): u along the wall to the right,
v up, w out of the wall. An opening is a row (u0, v0, u1, v1) in metres; it gets reveals, a frame, a
sill and panes, which show a texture of rooms with curtains or blinds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.grain import texture
from streetgen.geometry.layout import Plot
from streetgen.geometry.mesh import F32, F64, Mesh, Texture
from streetgen.geometry.solids import Surface, boxes, quads, tube

ROOMS = 16
SIDE_PX = 256
CURTAINS = ((128, 120, 105), (90, 45, 38), (142, 142, 138), (68, 75, 90))


def rooms(rng: np.random.Generator) -> Texture:
    """Return 16 rooms beside each other, 256 px each."""
    return texture(np.concatenate([_room(i, rng) for i in range(ROOMS)], axis=1))


def room_uv(rng: np.random.Generator, count: int) -> F32:
    """Return where ``count`` panes show a room each [N, 4, 2], as ``solids.quads`` takes it."""
    left = rng.integers(0, ROOMS, count) / ROOMS
    right = left + 1 / ROOMS
    inset = 0.02 / ROOMS
    u = np.stack([left + inset, right - inset, right - inset, left + inset], axis=1)
    v = np.broadcast_to([0.99, 0.99, 0.01, 0.01], (count, 4))
    return np.stack([u, v], axis=2).astype(np.float32)


def _room(number: int, rng: np.random.Generator) -> F32:
    grey = np.float32(rng.uniform(14, 34))
    room = np.full((SIDE_PX, SIDE_PX, 3), grey, np.float32)
    room *= np.array([1.0, 1.02, 1.08], np.float32)
    room *= np.linspace(1.5, 0.6, SIDE_PX, dtype=np.float32)[:, None, None]
    if number % 4 == 3:
        _lower_blind(room, rng)
    else:
        _draw_curtains(room, CURTAINS[number // 4], rng)
    return room


def _draw_curtains(room: F32, colour: tuple[int, int, int], rng: np.random.Generator) -> None:
    width = int(rng.uniform(0.12, 0.48) * SIDE_PX)
    folds = 0.75 + 0.25 * np.sin(np.arange(SIDE_PX) / rng.uniform(3, 6))
    cloth = (folds[:, None] * np.array(colour)).astype(np.float32)
    room[:, :width] = cloth[:width]
    room[:, SIDE_PX - width :] = cloth[SIDE_PX - width :]


def _lower_blind(room: F32, rng: np.random.Generator) -> None:
    height = int(rng.uniform(0.2, 0.8) * SIDE_PX)
    slats = np.where(np.arange(height) % 12 < 9, 1.0, 0.55).astype(np.float32)
    room[:height] = slats[:, None, None] * np.array((118, 116, 110), np.float32)


GLASS = Surface("glass", Label.WINDOW)
FRAME_M = 0.05


def wall_around(width_m: float, low_m: float, high_m: float, openings: F64) -> F64:
    """Return the rectangles that fill a storey but for its openings, which lie side by side."""
    ordered = openings[np.argsort(openings[:, 0])]
    u0, v0, u1, v1 = ordered.T
    lows, highs = np.full(len(u0), low_m), np.full(len(u0), high_m)
    starts, ends = np.append(0.0, u1), np.append(u0, width_m)
    piers = np.stack([starts, np.append(lows, low_m), ends, np.append(highs, high_m)], axis=1)
    below = np.stack([u0, lows, u1, v0], axis=1)
    above = np.stack([u0, v1, u1, highs], axis=1)
    every = np.concatenate([piers, below, above])
    return np.asarray(every[(every[:, 2] > every[:, 0]) & (every[:, 3] > every[:, 1])])


def upright(surface: Surface, areas: F64, out_m: float = 0.0) -> Mesh:
    """Return rectangles [N, 4] that look out of the wall, ``out_m`` before it."""
    corners = _corners(areas, out_m)
    return quads(surface, corners, corners[..., :2] * (1, -1) / surface.tile_m)


def panes(openings: F64, depth_m: float, rng: np.random.Generator) -> Mesh:
    """Return the glass of windows, a room behind each."""
    return quads(GLASS, _corners(openings, -depth_m), room_uv(rng, len(openings)))


def reveals(surface: Surface, openings: F64, depth_m: float) -> Mesh:
    """Return the four inner sides of each opening."""
    front, back = _corners(openings, 0.0), _corners(openings, -depth_m)
    sides = [
        np.stack([front[:, i], back[:, i], back[:, j], front[:, j]], axis=1)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    corners = np.concatenate(sides)
    uv = np.stack([corners[..., 0] + corners[..., 2], -corners[..., 1]], axis=2) / surface.tile_m
    return quads(surface, corners, uv)


def frames(surface: Surface, openings: F64, depth_m: float, bars: tuple[int, int]) -> Mesh:
    """Return a frame in each opening with so many bars across u and across v."""
    u0, v0, u1, v1 = openings.T
    t = FRAME_M
    parts = [(u0, v0, u0 + t, v1), (u1 - t, v0, u1, v1)]
    parts += [(u0 + t, v0, u1 - t, v0 + t), (u0 + t, v1 - t, u1 - t, v1)]
    for i in range(1, bars[0] + 1):
        u = u0 + (u1 - u0) * i / (bars[0] + 1)
        parts.append((u - 0.03, v0 + t, u + 0.03, v1 - t))
    for i in range(1, bars[1] + 1):
        v = v0 + (v1 - v0) * (0.68 if bars[1] == 1 else i / (bars[1] + 1))
        parts.append((u0 + t, v - 0.02, u1 - t, v + 0.02))
    areas = np.concatenate([np.stack(part, axis=1) for part in parts])
    return _slab(surface, areas, -depth_m, -depth_m + 0.05)


def sills(surface: Surface, openings: F64) -> Mesh:
    """Return a sill under each opening."""
    u0, v0, u1, _ = openings.T
    return _slab(surface, np.stack([u0 - 0.08, v0 - 0.09, u1 + 0.08, v0], axis=1), -0.02, 0.09)


def _slab(surface: Surface, areas: F64, near_m: float, far_m: float) -> Mesh:
    u0, v0, u1, v1 = areas.T
    ones = np.ones_like(u0)
    return boxes(
        surface,
        np.stack([u0, v0, near_m * ones], axis=1),
        np.stack([u1, v1, far_m * ones], axis=1),
    )


def _corners(areas: F64, out_m: float) -> F64:
    u0, v0, u1, v1 = areas.T
    w = np.full_like(u0, out_m)
    points = [np.stack([u, v, w], axis=1) for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))]
    return np.stack(points, axis=1)


DEPTH_M = 0.18
STONE = Surface("trim", Label.BUILDING)
METAL = Surface("metal", Label.BUILDING)


@dataclass(frozen=True)
class BuildingStyle:
    """The surfaces that a building is made of."""

    wall: Surface
    frame: Surface
    door: Surface


def facade(plot: Plot, style: BuildingStyle, rng: np.random.Generator) -> list[Mesh]:
    """Return everything of a facade but signs, for which it leaves the fascia bare."""
    bay_count = max(2, int(plot.width_m / rng.uniform(2.5, 3.1)))
    bay_m = plot.width_m / bay_count
    return [
        *_ground_floor(plot, style, bay_m, rng),
        *_upper_floors(plot, style, bay_m, rng),
        *_edges(plot, style),
    ]


def _upper_floors(
    plot: Plot, style: BuildingStyle, bay_m: float, rng: np.random.Generator
) -> list[Mesh]:
    wide, high, sill = rng.uniform((1.05, 1.6, 0.65), (1.45, 2.0, 0.85))
    bars = ((1, 1), (1, 0), (0, 1), (1, 2))[int(rng.integers(0, 4))]
    middles = (np.arange(round(plot.width_m / bay_m)) + 0.5) * bay_m
    storeys, walls = [], []
    for floor in range(plot.floors):
        low = plot.ground_m + floor * plot.floor_m
        lows = np.full_like(middles, low + sill)
        windows = np.stack([middles - wide / 2, lows, middles + wide / 2, lows + high], axis=1)
        storeys.append(windows)
        walls.append(wall_around(plot.width_m, low, low + plot.floor_m, windows))
    windows = np.concatenate(storeys)
    meshes = [upright(style.wall, np.concatenate(walls)), *_windows(style, windows, bars, rng)]
    if rng.random() < 0.5:
        meshes += _lintels(windows)
    balconies = windows[rng.random(len(windows)) < rng.choice((0.0, 0.0, 0.2, 0.35))]
    return meshes + [mesh for window in balconies for mesh in _balcony(window)]


def _windows(
    style: BuildingStyle, openings: F64, bars: tuple[int, int], rng: np.random.Generator
) -> list[Mesh]:
    return [
        reveals(style.wall, openings, DEPTH_M),
        panes(openings, DEPTH_M, rng),
        frames(style.frame, openings, DEPTH_M, bars),
        sills(STONE, openings),
    ]


def _ground_floor(
    plot: Plot, style: BuildingStyle, bay_m: float, rng: np.random.Generator
) -> list[Mesh]:
    count = round(plot.width_m / bay_m)
    door_at = int(rng.integers(0, count))
    shop = rng.random() < 0.6
    middles = (np.arange(count) + 0.5) * bay_m
    half, low, high = (bay_m / 2 - 0.2, 0.6, 3.15) if shop else (0.65, 1.2, 3.0)
    windows = np.stack(
        [middles - half, np.full(count, low), middles + half, np.full(count, high)], axis=1
    )
    windows = np.delete(windows, door_at, axis=0)
    door = np.array([[middles[door_at] - 0.6, 0.14, middles[door_at] + 0.6, 2.75]])
    wall = wall_around(plot.width_m, 0.0, plot.ground_m, np.concatenate([windows, door]))
    meshes = [upright(style.wall, wall), *_windows(style, windows, (1, 0) if shop else (1, 1), rng)]
    meshes += [reveals(style.wall, door, DEPTH_M), upright(style.door, door, -DEPTH_M)]
    u0, v0, u1, _ = door[0]
    knob = boxes(METAL, (u1 - 0.16, 1.05, -DEPTH_M), (u1 - 0.1, 1.25, -DEPTH_M + 0.07))
    step = boxes(STONE, (u0 - 0.1, 0.0, -DEPTH_M), (u1 + 0.1, v0 + 0.02, 0.3))
    panels = [
        boxes(style.door, (u0 + a, v0 + b, -DEPTH_M), (u0 + a + 0.4, v0 + b + 0.9, -DEPTH_M + 0.03))
        for a in (0.14, 0.66)
        for b in (0.25, 1.4)
    ]
    return [*meshes, knob, step, *panels]


def _lintels(windows: F64) -> list[Mesh]:
    u0, v0, u1, v1 = windows.T
    zero = np.zeros_like(u0)
    heads = boxes(
        STONE,
        np.stack([u0 - 0.14, v1 + 0.02, zero - 0.02], axis=1),
        np.stack([u1 + 0.14, v1 + 0.24, zero + 0.07], axis=1),
    )
    sides = [
        boxes(
            STONE,
            np.stack([u, v0, zero], axis=1),
            np.stack([u + 0.12, v1 + 0.02, zero + 0.05], axis=1),
        )
        for u in (u0 - 0.14, u1 + 0.02)
    ]
    return [heads, *sides]


def _balcony(window: F64) -> list[Mesh]:
    u0, low, u1, _ = window
    floor = boxes(STONE, (u0 - 0.25, low - 0.25, 0), (u1 + 0.25, low - 0.1, 0.95))
    front = np.linspace(u0 - 0.22, u1 + 0.22, 14)
    bars = np.concatenate(
        [
            np.stack([front, np.full(14, 0.9)], axis=1),
            [(u, w) for u in (u0 - 0.22, u1 + 0.22) for w in np.linspace(0.05, 0.8, 7)],
        ]
    )
    low_ends = np.stack([bars[:, 0] - 0.009, np.full(len(bars), low - 0.1), bars[:, 1]], axis=1)
    railing = boxes(METAL, low_ends, low_ends + np.array([0.018, 0.95, 0.018]))
    rails = boxes(
        METAL,
        [(u0 - 0.24, low + 0.85, 0.88), (u0 - 0.24, low + 0.85, 0.0), (u1 + 0.2, low + 0.85, 0.0)],
        [(u1 + 0.24, low + 0.9, 0.94), (u0 - 0.2, low + 0.9, 0.94), (u1 + 0.24, low + 0.9, 0.94)],
    )
    return [floor, railing, rails]


def _edges(plot: Plot, style: BuildingStyle) -> list[Mesh]:
    """Return plinth, string course, cornice, the wall under the eaves, and a rain pipe."""
    width, top = plot.width_m, plot.height_m
    eaves = plot.ground_m + plot.floors * plot.floor_m
    courses = boxes(
        STONE,
        [(0, 0, 0), (0, plot.ground_m - 0.12, -0.01), (0, top - 0.3, 0), (0, top - 0.12, 0)],
        [
            (width, 0.45, 0.05),
            (width, plot.ground_m + 0.1, 0.1),
            (width, top - 0.12, 0.25),
            (width, top, 0.4),
        ],
    )
    frieze = upright(style.wall, np.array([[0, eaves, width, top]]))
    pipe = tube(METAL, [(0.18, 0.0, 0.09), (0.18, top - 0.2, 0.09)], 0.05, 8)
    return [courses, frieze, pipe]
