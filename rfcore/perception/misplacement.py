"""Estimates by which angle a picture is misplaced: its pose says one place, its pixels another.

A picture whose pose is wrong differs wherever the field has edges, and one error can hide another:
half a metre to the right and a degree to the left leave most of a street where it was. So the
picture is not judged by how much of it differs, but by where it would fit: direct alignment (Lucas
and Kanade; on depth, Kerl et al., ICRA 2013) of the picture with the field's render, both as means
of ``WIDE`` squares across. With R, Z the render and its depth, X = Z (x, y, 1) a point of it, I the
picture and M the motion from the stated pose to the one that fits::

    r = I(pi(M X)) - R,    J = grad I dpi/dX [1 | -[X]x],    delta = argmin sum w (r - J delta)^2

with weights of Cauchy at 1.5 times the median of the absolute r, so that objects that are not in
the field hardly count. The misplacement is the angle that a quarter of the points would move by or
more, seen from the camera; it is 0 where they would not fit ``BETTER`` there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics, Pose
from rfcore.motion import quaternion_from_vector

WIDE = 80
"""Squares across a picture; with 80, errors of 5 degrees can be found."""
ROUNDS = 24
"""Most rounds. At the right pose or nearly so 4 to 12 suffice, a wrong one takes all; after 12 a
few of those were not half-way yet."""
CONVERGED = 1e-3
"""Metres and radians; 1e-4 takes half as long again at the right pose for the same answer."""
SHARE = 0.75
BETTER = 0.95
"""A fit must lower the median residual to this share, or the picture fits nowhere, as one that a
van fills."""
LEAST_POINTS = 100
NEAREST_M = 0.3
DAMPING = 1e-3
LEAST_SPREAD_LEVELS = 1.0

F64 = NDArray[np.float64]


def misplacement_rad(
    levels: NDArray[np.float32],
    render: NDArray[np.float32],
    depth: NDArray[np.float32],
    intrinsics: Intrinsics,
) -> float:
    """Return the angle by which the picture is misplaced.

    ``levels`` and ``render``: one channel of the picture and of the field's render in its light,
    float32 [H, W]; ``depth``: the field's, metres, 0 where it has no surface. 0 for a picture that
    is too small, or has too little of the field in it, to tell.
    """
    size = max(1, round(intrinsics.width_px / WIDE))
    cells = _Cells.of(levels, render, depth, intrinsics, size)
    if len(cells.levels) < LEAST_POINTS:
        return 0.0
    motion, before = Pose.identity(), np.inf
    for number in range(ROUNDS):
        step, residual = _step(cells, motion)
        if number == 0:
            before = residual
        motion = Pose((step[0], step[1], step[2]), quaternion_from_vector(tuple(step[3:]))).compose(
            motion
        )
        if np.abs(step).max() < CONVERGED:
            break
    if _step(cells, motion)[1] > BETTER * before:
        return 0.0
    return cells.moved_rad(motion)


@dataclass(frozen=True, eq=False)
class _Cells:
    """A picture [h, w] with its gradients [h, w, 3], and the points [N, 3] of the render, in the
    axes of the camera, with their ``levels`` [N]. ``focal`` and ``centre`` (x, y) in cells."""

    picture: F64
    points_m: F64
    levels: F64
    focal: F64
    centre: F64

    @staticmethod
    def of(
        levels: NDArray[np.float32],
        render: NDArray[np.float32],
        depth: NDArray[np.float32],
        k: Intrinsics,
        size: int,
    ) -> _Cells:
        """Return means of squares of ``size`` pixels; of points where all of one has a surface."""
        picture, ground = _means(levels, size), _means(render, size)
        depth_m = _means(depth, size)
        whole = (_means((depth > 0).astype(np.float32), size) > 0.99) & (depth_m > NEAREST_M)
        focal = np.array([k.fx_px, k.fy_px]) / size
        centre = np.array([k.cx_px, k.cy_px]) / size - 0.5
        rows, columns = np.nonzero(whole)
        rays = (np.stack([columns, rows], axis=1) - centre) / focal
        points_m = np.concatenate([rays, np.ones((len(rows), 1))], axis=1)
        points_m *= depth_m[rows, columns][:, None]
        down, across = np.gradient(picture) if min(picture.shape) > 1 else (picture, picture)
        return _Cells(
            np.stack([picture, across, down], axis=2),
            points_m,
            ground[rows, columns],
            focal,
            centre,
        )

    def moved_rad(self, motion: Pose) -> float:
        """Return by how much a quarter of the points moves at least, seen from the camera."""
        moved_m = _moved(self.points_m, motion)
        shift = moved_m[:, :2] / moved_m[:, 2:] - self.points_m[:, :2] / self.points_m[:, 2:]
        return float(np.quantile(np.linalg.norm(shift, axis=1), SHARE))


def _step(cells: _Cells, motion: Pose) -> tuple[F64, float]:
    """Return the next step [6], translation and rotation, and the median residual before it."""
    moved_m = _moved(cells.points_m, motion)
    at = moved_m[:, :2] / moved_m[:, 2:] * cells.focal + cells.centre
    height, width = cells.picture.shape[:2]
    inside = ((at >= 0) & (at <= (width - 1.01, height - 1.01))).all(axis=1)
    inside &= moved_m[:, 2] > NEAREST_M
    if inside.sum() < LEAST_POINTS:
        return np.zeros(6), np.inf
    samples = _sampled(cells.picture, at[inside])
    residuals = samples[:, 0] - cells.levels[inside]
    moves = _moves(moved_m[inside], cells.focal)
    terms = samples[:, 1:2] * moves[:, 0] + samples[:, 2:3] * moves[:, 1]
    spread = float(np.median(np.abs(residuals)))
    weights = 1 / (1 + (residuals / (1.5 * spread + LEAST_SPREAD_LEVELS)) ** 2)
    weighted = (terms * weights[:, None]).T
    normal = weighted @ terms
    normal += np.diag(DAMPING * (np.diag(normal) + 1.0))
    return np.asarray(-np.linalg.solve(normal, weighted @ residuals), np.float64), spread


def _moves(points_m: F64, focal: F64) -> F64:
    """Return how points [N, 3] move in the picture, cells [N, 2, 6], for each metre and radian."""
    near = 1 / points_m[:, 2]
    x, y, none = points_m[:, 0] * near, points_m[:, 1] * near, np.zeros(len(points_m))
    across = np.stack([near, none, -x * near, -x * y, 1 + x * x, -y], axis=1) * focal[0]
    down = np.stack([none, near, -y * near, -(1 + y * y), x * y, x], axis=1) * focal[1]
    return np.stack([across, down], axis=1)


def _moved(points_m: F64, motion: Pose) -> F64:
    moved_m = points_m @ np.array(motion.rotation_matrix()).T + np.array(motion.translation_m)
    moved_m[:, 2] = np.maximum(moved_m[:, 2], NEAREST_M / 2)
    return np.asarray(moved_m)


def _means(values: NDArray[np.float32], size: int) -> F64:
    """Return the means of squares, float64 [H // size, W // size]."""
    height, width = values.shape[0] // size, values.shape[1] // size
    squares = values[: height * size, : width * size].reshape(height, size, width, size)
    return np.asarray(squares.mean(axis=1).mean(axis=2), np.float64)


def _sampled(values: F64, at: F64) -> F64:
    """Return ``values`` [h, w, C] at points (x, y) [N, 2] inside of it, bilinearly, [N, C]."""
    left, top = at.astype(np.intp).T
    across, down = (at - np.floor(at)).T[..., None]
    upper = values[top, left] * (1 - across) + values[top, left + 1] * across
    lower = values[top + 1, left] * (1 - across) + values[top + 1, left + 1] * across
    return np.asarray(upper * (1 - down) + lower * down)
