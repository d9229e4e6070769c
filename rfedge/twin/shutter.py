"""Pictures of rolling shutters: each row or column as it was seen at its own instant.

The first line is seen at the start of the exposure, the last at its end, the others evenly between.
Poses are interpolated by halving, which needs a square root only: the same bits on every machine.

Lines are drawn in bands, each at the pose of its middle. While the lines of a band are read, the
picture moves there by at most ``MOST_PX``, by the depth at the middle of the exposure; so a pixel
is at most half as far from where its own line has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import RadianceField
from rfcore.field.interface import Bounds
from rfcore.image import Rgb
from rfedge.twin.lens_picture import LensModel, render_part

F64 = NDArray[np.float64]

MOST_PX = 1.0
DEPTH_STEP = 4
"""Pixels of the picture, along each side, for one of the depth that bands are planned with."""
NEAREST_M = 0.01
HALVINGS = 24


@dataclass(frozen=True)
class Motion:
    """A pose at the start and at the end of an exposure."""

    start: Pose
    end: Pose

    @property
    def moves(self) -> bool:
        """Whether the two differ."""
        return self.start != self.end

    @property
    def middle(self) -> Pose:
        """The pose half way."""
        return _half_way(self.start, self.end)

    def at(self, share: float) -> Pose:
        """Return the pose at this share of the exposure, 0..1, to 2^-24 of it: turned evenly about
        one axis, moved along a straight line."""
        low, high = self.start, self.end
        if share == 1 or not self.moves:
            return high
        for _ in range(HALVINGS):
            if share == 0:
                break
            half, share = _half_way(low, high), 2 * share
            if share < 1:
                high = half
            else:
                low, share = half, share - 1
        return low


def _half_way(first: Pose, second: Pose) -> Pose:
    a, b = first.rotation, second.rotation
    sign = 1.0 if sum(p * q for p, q in zip(a, b, strict=True)) >= 0 else -1.0
    total = [p + sign * q for p, q in zip(a, b, strict=True)]
    norm = math.sqrt(sum(value * value for value in total))
    w, x, y, z = (value / norm for value in total)
    x_m, y_m, z_m = (
        0.5 * (p + q) for p, q in zip(first.translation_m, second.translation_m, strict=True)
    )
    return Pose((x_m, y_m, z_m), (w, x, y, z))


@dataclass(frozen=True)
class Shutter:
    """The order in which lines are read: rows from the top, unless told otherwise."""

    columns: bool = False
    reverse: bool = False

    def instant(self, line: float, lines: int) -> float:
        """Return the share of the exposure, 0..1, at which line 0..``lines`` - 1 is read."""
        share = line / (lines - 1) if lines > 1 else 0.5
        return 1 - share if self.reverse else share


@dataclass(frozen=True)
class MovingBox:
    """A box in the axes of an object, and where the object is."""

    bounds: Bounds
    world_from_object: Motion


def render_rolling(
    field_at: Callable[[float], RadianceField],
    model: LensModel,
    world_from_cam: Motion,
    shutter: Shutter,
    motion_px: F64,
) -> Rgb:
    """Return the picture, uint8 [H, W, 3].

    ``field_at``: the field at a share of the exposure. ``motion_px``: ``lines_motion_px``.
    """
    k = model.intrinsics
    picture = np.empty((k.height_px, k.width_px, 3), np.uint8)
    for first, end in bands(motion_px):
        share = shutter.instant(0.5 * (first + end - 1), len(motion_px))
        lines = slice(first, end)
        part = (slice(None), lines) if shutter.columns else (lines, slice(None))
        picture[part] = render_part(field_at(share), model, world_from_cam.at(share), part)
    return picture


def bands(motion_px: F64) -> Iterator[tuple[int, int]]:
    """Return [first, end) of bands of lines, of which each moves by ``motion_px`` [lines] during
    the exposure."""
    most = MOST_PX * (len(motion_px) - 1)
    first, fastest = 0, 0.0
    for line, moves in enumerate(motion_px.tolist()):
        fastest = max(fastest, moves)
        if line > first and (line - first) * fastest > most:
            yield first, line
            first, fastest = line, moves
    yield first, len(motion_px)


def lines_motion_px(
    field: RadianceField,
    model: LensModel,
    world_from_cam: Motion,
    shutter: Shutter,
    boxes: Sequence[MovingBox] = (),
) -> F64:
    """Return by how many pixels each line's fastest pixel moves during the exposure: those of the
    ``field``, by its depth at the middle, and those of the ``boxes``."""
    pinhole = model.pinhole
    small = pinhole.resized(-(-pinhole.width_px // DEPTH_STEP), -(-pinhole.height_px // DEPTH_STEP))
    moves = _scene_motion(field, small, world_from_cam)
    for box in boxes:
        _add_box(moves, small, world_from_cam, box)
    rows, columns = model.pinhole_pixels()
    across = moves[rows // DEPTH_STEP, columns // DEPTH_STEP]
    scale = max(pinhole.width_px / small.width_px, pinhole.height_px / small.height_px)
    return np.asarray(scale * across.max(axis=0 if shutter.columns else 1))


def _scene_motion(field: RadianceField, k: Intrinsics, world_from_cam: Motion) -> F64:
    """Return twice the way of each pixel [H, W] from the middle to the farther end; the way of a
    pixel without depth is that of the sky."""
    middle = world_from_cam.middle
    depth_m = field.render(Camera(k, middle)).depth.astype(np.float64)
    v, u = np.mgrid[: k.height_px, : k.width_px] + 0.5
    x, y = (u - k.cx_px) / k.fx_px, (v - k.cy_px) / k.fy_px
    nearness = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
    farthest = np.zeros_like(x)
    for pose in (world_from_cam.start, world_from_cam.end):
        then_from_middle = pose.inverse().compose(middle)
        rotation, shift_m = then_from_middle.rotation_matrix(), then_from_middle.translation_m
        there = [
            r[0] * x + r[1] * y + r[2] + t * nearness
            for r, t in zip(rotation, shift_m, strict=True)
        ]
        ahead = there[2] > NEAREST_M * nearness
        z = np.where(ahead, there[2], 1.0)
        du, dv = k.fx_px * (there[0] / z - x), k.fy_px * (there[1] / z - y)
        way = np.where(ahead, np.sqrt(du * du + dv * dv), k.width_px + k.height_px)
        farthest = np.maximum(farthest, way)
    return np.asarray(2 * farthest)


def _add_box(moves: F64, k: Intrinsics, world_from_cam: Motion, box: MovingBox) -> None:
    """Raise ``moves`` to a box's where its picture is during the exposure."""
    corners = list(product(*zip(box.bounds.low_m, box.bounds.high_m, strict=True)))
    seen = [
        [Camera(k, world_from_cam.at(share)).project(world_from_object.apply(corner))
         for corner in corners]
        for share in (0.5, 0.0, 1.0)
        for world_from_object in (box.world_from_object.at(share),)
    ]  # fmt: skip
    depths = [z for instant in seen for _, _, z in instant]
    if max(depths) <= NEAREST_M:
        return
    if min(depths) <= NEAREST_M:
        np.maximum(moves, k.width_px + k.height_px, out=moves)
        return
    way = max(
        math.sqrt((u - u0) * (u - u0) + (v - v0) * (v - v0))
        for instant in seen[1:]
        for (u0, v0, _), (u, v, _) in zip(seen[0], instant, strict=True)
    )
    across, down = (
        slice(
            math.floor(min(max(min(values) - 1, 0), side)),
            math.ceil(min(max(max(values) + 1, 0), side)),
        )
        for values, side in (
            ([u for instant in seen for u, _, _ in instant], k.width_px),
            ([v for instant in seen for _, v, _ in instant], k.height_px),
        )
    )
    np.maximum(moves[down, across], 2 * way, out=moves[down, across])
