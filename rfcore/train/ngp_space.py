"""Where a hash grid is put, and what of it may be occupied, from cameras and surface points.

The box holds the cameras and what is near them; the contraction takes care of the rest. Points,
where a dataset has any, say which cells can hold a surface, and training begins with those alone:
on the street that is one cell in twenty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.ngp.shape import Space
from rfcore.views import PointCloud

__all__ = ["cells_near", "occupancy_cells", "space_around"]

MARGIN_SHARE = 0.01
"""Of the box's longest side, added around the points in it."""
KEPT_SHARE = 0.995
"""Of the points near the cameras lie in the box, along each axis and side."""
SAMPLE = 8192
"""Points looked at to find how far surfaces are from the cameras."""

F64 = NDArray[np.float64]
Cells = tuple[int, int, int]


def space_around(cameras: Sequence[Camera], points: PointCloud | None) -> Space:
    """Return an unbounded space whose box holds the cameras and the nearer half of the points.

    Without points: the cameras, and what lies before them as far as they lie apart.
    """
    if not cameras:
        raise InvalidInput("cameras", "at least one is needed to place a field")
    centres = np.array([camera.world_from_cam.translation_m for camera in cameras])
    corners = _looked_at(cameras, centres) if points is None else _near(centres, points)
    low, high = (np.percentile(corners, 100 * share, axis=0) for share in _shares(points))
    low, high = np.minimum(low, centres.min(axis=0)), np.maximum(high, centres.max(axis=0))
    margin = max(MARGIN_SHARE * float((high - low).max()), 1e-3)
    half, centre = (high - low) / 2 + margin, (high + low) / 2
    return Space(_triple(centre), _triple(half), unbounded=True)


def _shares(points: PointCloud | None) -> tuple[float, float]:
    return (0.0, 1.0) if points is None else (1 - KEPT_SHARE, KEPT_SHARE)


def _looked_at(cameras: Sequence[Camera], centres: F64) -> F64:
    """Return the points before the cameras at once and twice the radius of their positions."""
    axes = np.array([camera.world_from_cam.rotation_matrix() for camera in cameras])[:, :, 2]
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    reach_m = max(float(radius), 1.0)
    return np.concatenate([centres + 0.5 * reach_m * axes, centres + reach_m * axes])


def _near(centres: F64, points: PointCloud) -> F64:
    """Return the points no farther from the cameras' box than half of them are from a camera."""
    xyz = points.xyz_m.astype(np.float64)
    if not len(xyz):
        raise InvalidInput("points", "there are none; leave them out")
    some = xyz[:: max(1, len(xyz) // SAMPLE)]
    reach_m = np.median([np.sqrt(((centres - p) ** 2).sum(axis=1).min()) for p in some])
    low, high = centres.min(axis=0) - reach_m, centres.max(axis=0) + reach_m
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    return xyz[inside] if inside.any() else xyz


def _triple(values: F64) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def occupancy_cells(space: Space, budget: int) -> Cells:
    """Return cells along x, y, z: about ``budget`` in all, as long as wide in the box."""
    volume = math.prod(space.aspect)
    along_longest = (budget / volume) ** (1 / 3)
    x, y, z = (max(8, round(along_longest * share)) for share in space.aspect)
    return (x, y, z)


def cells_near(space: Space, cells: Cells, points: PointCloud) -> NDArray[np.bool_]:
    """Return [X Y Z], x fastest: whether a cell or one of its 26 neighbours holds a point."""
    x = (points.xyz_m.astype(np.float64) - space.centre_m) / space.half_m
    outside = np.maximum(np.abs(x).max(axis=1, keepdims=True), 1.0)
    u = 0.5 + 0.25 * (2 - 1 / outside) * x / outside
    at = np.minimum((u * cells).astype(np.int64), np.array(cells) - 1)
    grid = np.zeros((cells[2] + 2, cells[1] + 2, cells[0] + 2), bool)
    grid[at[:, 2] + 1, at[:, 1] + 1, at[:, 0] + 1] = True
    for axis in range(3):
        grid |= np.roll(grid, 1, axis) | np.roll(grid, -1, axis)
    return np.ascontiguousarray(grid[1:-1, 1:-1, 1:-1]).ravel()
