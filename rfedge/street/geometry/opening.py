"""Holes in a facade and what fills them: reveals, panes, frames, sills, doors.

All in the facade's own axes: u along the wall to the right, v up, w out of the wall. An opening is
a row (u0, v0, u1, v1) in metres.
"""

from __future__ import annotations

import numpy as np

from rfedge.street.geometry.mesh import F64, Label, Mesh
from rfedge.street.geometry.solids import Stuff, boxes, quads
from rfedge.street.geometry.window_texture import room_uv

__all__ = ["frames", "panes", "reveals", "sills", "upright", "wall_around"]

GLASS = Stuff("glass", Label.WINDOW)
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


def upright(stuff: Stuff, areas: F64, out_m: float = 0.0) -> Mesh:
    """Return rectangles [N, 4] that look out of the wall, ``out_m`` before it."""
    corners = _corners(areas, out_m)
    return quads(stuff, corners, corners[..., :2] * (1, -1) / stuff.tile_m)


def panes(openings: F64, depth_m: float, rng: np.random.Generator) -> Mesh:
    """Return the glass of windows, a room behind each."""
    return quads(GLASS, _corners(openings, -depth_m), room_uv(rng, len(openings)))


def reveals(stuff: Stuff, openings: F64, depth_m: float) -> Mesh:
    """Return the four inner sides of each opening."""
    front, back = _corners(openings, 0.0), _corners(openings, -depth_m)
    sides = [
        np.stack([front[:, i], back[:, i], back[:, j], front[:, j]], axis=1)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))
    ]
    corners = np.concatenate(sides)
    uv = np.stack([corners[..., 0] + corners[..., 2], -corners[..., 1]], axis=2) / stuff.tile_m
    return quads(stuff, corners, uv)


def frames(stuff: Stuff, openings: F64, depth_m: float, bars: tuple[int, int]) -> Mesh:
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
    return _slab(stuff, areas, -depth_m, -depth_m + 0.05)


def sills(stuff: Stuff, openings: F64) -> Mesh:
    """Return a sill under each opening."""
    u0, v0, u1, _ = openings.T
    return _slab(stuff, np.stack([u0 - 0.08, v0 - 0.09, u1 + 0.08, v0], axis=1), -0.02, 0.09)


def _slab(stuff: Stuff, areas: F64, near_m: float, far_m: float) -> Mesh:
    u0, v0, u1, v1 = areas.T
    ones = np.ones_like(u0)
    return boxes(
        stuff,
        np.stack([u0, v0, near_m * ones], axis=1),
        np.stack([u1, v1, far_m * ones], axis=1),
    )


def _corners(areas: F64, out_m: float) -> F64:
    u0, v0, u1, v1 = areas.T
    w = np.full_like(u0, out_m)
    points = [np.stack([u, v, w], axis=1) for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))]
    return np.stack(points, axis=1)
