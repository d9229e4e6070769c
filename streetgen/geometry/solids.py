"""Make the simple bodies that streets consist of: rectangles, boxes, tubes, lofts and discs.

Texture coordinates are metres over ``tile_m``, the side of a texture on the wall, so that bricks
are of one size everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.mesh import F32, I32, Mesh

BOX_SIDES = np.array(
    [
        [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)],
        [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
        [(1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)],
        [(0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)],
        [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
    ]
)
"""Corners of a box's six sides, anticlockwise from outside, as indices into (low, high)."""
BOX_AXES = np.array([(0, 1), (0, 1), (0, 2), (0, 2), (1, 2), (1, 2)])
"""The two axes along which each side's texture runs."""
WHOLE_TEXTURE = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
"""Texture coordinates of a rectangle whose first corner is the lower left of the picture."""


@dataclass(frozen=True)
class Surface:
    """A body's material and class; ``tile_m`` is the side of its texture, m."""

    material: str
    label: Label
    tile_m: float = 4.0


def quads(surface: Surface, corners: ArrayLike, uv: ArrayLike | None = None) -> Mesh:
    """Return rectangles from corners [N, 4, 3], anticlockwise from the lower left.

    ``uv`` [N, 4, 2]; without it each shows its whole texture.
    """
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    if uv is None:
        texture = np.broadcast_to(WHOLE_TEXTURE, (len(points), 4, 2))
    else:
        texture = np.asarray(uv, np.float32).reshape(-1, 4, 2)
    first = np.arange(0, 4 * len(points), 4, dtype=np.int32)[:, None, None]
    return Mesh(
        vertices=points.reshape(-1, 3),
        faces=(first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3),
        uv=np.ascontiguousarray(texture.reshape(-1, 2)),
        material=surface.material,
        label=surface.label,
    )


def boxes(surface: Surface, low: ArrayLike, high: ArrayLike) -> Mesh:
    """Return closed boxes between the corners ``low`` and ``high``, [3] or [N, 3]."""
    lows, highs = np.broadcast_arrays(np.atleast_2d(low), np.atleast_2d(high))
    ends = np.stack([lows, highs], axis=1).astype(np.float32)
    corners = np.stack([ends[:, BOX_SIDES[..., axis], axis] for axis in range(3)], axis=-1)
    uv = np.take_along_axis(corners, BOX_AXES[None, :, None, :], axis=3) / np.float32(
        surface.tile_m
    )
    return quads(surface, corners, uv * np.array([1, -1], np.float32))


def tube(surface: Surface, path: ArrayLike, radius_m: ArrayLike, sides: int = 10) -> Mesh:
    """Return an open tube around a path [N, 3] with one radius or one for each of its points."""
    points = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius_m, np.float64), len(points))
    across, over = _frames(points)
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    normals = (
        across[:, None] * np.cos(turn)[None, :, None] + over[:, None] * np.sin(turn)[None, :, None]
    )
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps_m)]) / surface.tile_m
    uv = np.stack(np.broadcast_arrays(turn[None] / (2 * np.pi), along[:, None]), axis=-1)
    return Mesh(
        vertices=_flat(points[:, None] + normals * radii[:, None, None], 3),
        faces=_grid_faces(len(points), sides + 1),
        uv=_flat(uv, 2),
        material=surface.material,
        label=surface.label,
        normals=_flat(normals, 3),
    )


def loft(surface: Surface, sections: ArrayLike, sides: int = 12) -> Mesh:
    """Return a smooth body of level elliptical sections [N, 4], from the lowest to the highest.

    A section is (height, middle along x, half width along x, half width along y); the body is open
    where its first or last section has a width. Raises ``InvalidInput`` unless heights rise.
    """
    rings = np.asarray(sections, np.float64)
    if (np.diff(rings[:, 0]) <= 0).any():
        raise InvalidInput("loft.sections", f"heights {rings[:, 0].tolist()} do not rise")
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    points = _ellipses(rings, turn)
    up = _ellipses(np.gradient(rings, rings[:, 0], axis=0), turn)
    width, depth = rings[:, 2, None], rings[:, 3, None]
    round_ = np.stack(
        np.broadcast_arrays(-width * np.sin(turn), depth * np.cos(turn), 0.0), axis=-1
    )
    normals = np.cross(round_, up)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    uv = np.stack(
        np.broadcast_arrays(turn[None] / (2 * np.pi), rings[:, :1] / surface.tile_m), axis=-1
    )
    return Mesh(
        vertices=_flat(points, 3),
        faces=_grid_faces(len(rings), sides + 1),
        uv=_flat(uv, 2),
        material=surface.material,
        label=surface.label,
        normals=_flat(normals, 3),
    )


def _ellipses(rings: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the points [N, T, 3] of the sections [N, 4] that ``loft`` takes."""
    height, middle, half_x, half_y = (rings[:, i, None] for i in range(4))
    x, y = middle + half_x * np.cos(turn), half_y * np.sin(turn)
    return np.stack(np.broadcast_arrays(x, y, height), axis=-1)


def disc(
    surface: Surface, centre: ArrayLike, towards: ArrayLike, radius_m: float, sides: int = 24
) -> Mesh:
    """Return a disc that faces ``towards``; its texture is the picture it is cut from."""
    middle = np.asarray(centre, np.float64)
    normal = np.asarray(towards, np.float64) / np.linalg.norm(towards)
    across, over = _frame(normal)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * over
    picture = np.stack([0.5 + 0.5 * np.cos(turn), 0.5 - 0.5 * np.sin(turn)], axis=1)
    i = np.arange(sides, dtype=np.int32)
    return Mesh(
        vertices=_flat(np.concatenate([middle[None], middle + radius_m * ring]), 3),
        faces=np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % sides], axis=1).astype(np.int32),
        uv=_flat(np.concatenate([[[0.5, 0.5]], picture]), 2),
        material=surface.material,
        label=surface.label,
    )


def _frames(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions across a path at each of its points, which turn smoothly with it."""
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return _frame(along)


def _frame(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions [..., 3] that make right-handed systems with ``direction``."""
    upright = np.abs(direction[..., 2:]) > 0.9
    seen = np.where(upright, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    across = np.cross(seen, direction)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return across, np.cross(direction, across)


def _grid_faces(rows: int, columns: int) -> I32:
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None]).reshape(-1)
    lower = np.stack([first, first + 1, first + columns + 1], axis=1)
    upper = np.stack([first, first + columns + 1, first + columns], axis=1)
    return np.stack([lower, upper], axis=1).reshape(-1, 3).astype(np.int32)


def _flat(values: np.ndarray, width: int) -> F32:
    return np.ascontiguousarray(values.reshape(-1, width), dtype=np.float32)
