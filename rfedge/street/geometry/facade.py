"""A facade: shop or dwelling on the ground, windows above, and what sticks out of the wall.

In the facade's own axes (``Plot.world_from_facade``): u to the right, v up, w out of the wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfedge.street.geometry.layout import Plot
from rfedge.street.geometry.mesh import F64, Label, Mesh
from rfedge.street.geometry.opening import frames, panes, reveals, sills, upright, wall_around
from rfedge.street.geometry.solids import Stuff, boxes, tube

__all__ = ["Look", "facade"]

DEPTH_M = 0.18
STONE = Stuff("trim", Label.BUILDING)
METAL = Stuff("metal", Label.BUILDING)


@dataclass(frozen=True)
class Look:
    """What a building is made of."""

    wall: Stuff
    frame: Stuff
    door: Stuff


def facade(plot: Plot, look: Look, rng: np.random.Generator) -> list[Mesh]:
    """Return everything of a facade but signs, for which it leaves the fascia bare."""
    bay_count = max(2, int(plot.width_m / rng.uniform(2.5, 3.1)))
    bay_m = plot.width_m / bay_count
    return [
        *_ground_floor(plot, look, bay_m, rng),
        *_upper_floors(plot, look, bay_m, rng),
        *_edges(plot, look),
    ]


def _upper_floors(plot: Plot, look: Look, bay_m: float, rng: np.random.Generator) -> list[Mesh]:
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
    meshes = [upright(look.wall, np.concatenate(walls)), *_windows(look, windows, bars, rng)]
    if rng.random() < 0.5:
        meshes += _lintels(windows)
    balconies = windows[rng.random(len(windows)) < rng.choice((0.0, 0.0, 0.2, 0.35))]
    return meshes + [mesh for window in balconies for mesh in _balcony(window)]


def _windows(
    look: Look, openings: F64, bars: tuple[int, int], rng: np.random.Generator
) -> list[Mesh]:
    return [
        reveals(look.wall, openings, DEPTH_M),
        panes(openings, DEPTH_M, rng),
        frames(look.frame, openings, DEPTH_M, bars),
        sills(STONE, openings),
    ]


def _ground_floor(plot: Plot, look: Look, bay_m: float, rng: np.random.Generator) -> list[Mesh]:
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
    meshes = [upright(look.wall, wall), *_windows(look, windows, (1, 0) if shop else (1, 1), rng)]
    meshes += [reveals(look.wall, door, DEPTH_M), upright(look.door, door, -DEPTH_M)]
    u0, v0, u1, _ = door[0]
    knob = boxes(METAL, (u1 - 0.16, 1.05, -DEPTH_M), (u1 - 0.1, 1.25, -DEPTH_M + 0.07))
    step = boxes(STONE, (u0 - 0.1, 0.0, -DEPTH_M), (u1 + 0.1, v0 + 0.02, 0.3))
    panels = [
        boxes(look.door, (u0 + a, v0 + b, -DEPTH_M), (u0 + a + 0.4, v0 + b + 0.9, -DEPTH_M + 0.03))
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


def _edges(plot: Plot, look: Look) -> list[Mesh]:
    """Plinth, string course, cornice, the wall under the eaves, and a rain pipe."""
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
    frieze = upright(look.wall, np.array([[0, eaves, width, top]]))
    pipe = tube(METAL, [(0.18, 0.0, 0.09), (0.18, top - 0.2, 0.09)], 0.05, 8)
    return [courses, frieze, pipe]
