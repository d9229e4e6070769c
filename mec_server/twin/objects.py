"""Things that cameras see and the field does not have: found in pictures, followed over time.

Without clock, sockets or threads, and deterministic: the same pictures in the same order give the
same objects.

In one picture, blocks of 8x8 pixels of which more than half differ clearly from the field
(``mec_server.twin.composition``) are grouped with their eight neighbours. A group stands where its
lower edge touches the field: of each column, the field's surface just below the lowest pixel that
differs; of these points the nearer ones count, for the rest belong to the far side or to a gap
under the thing. Sideways it is where the middle of those is. Left out is a group whose lower edge
is not in the picture, not on ground that is level (z is up), or further away than ``REACH_M``:
mostly, that is the field's own error at the edges of facades, trees and roofs.

Over time and over cameras, a detection belongs to the nearest object not further away than
``GATE_M`` and a part of its distance from the camera, for that is how its error grows; greedy, the
nearest pair first. Between pictures objects move at constant velocity (an alpha-beta filter). One
is *confirmed* by a third picture and forgotten ``FORGOTTEN_S`` after its last.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mec_server.twin.composition import LivePicture
from mec_server.twin.state import CameraKey
from rfcore.camera import Intrinsics

__all__ = ["Detection", "FollowedObject", "ObjectTracker", "detect"]

BLOCK_PX = 8
LEAST_BLOCKS = 5
"""320 pixels: a thing of 400 is found."""
THING_LEVELS = 35.0
"""A pixel of a thing. On the sample's empty drive one picture of 12 has a group of 15 levels or
more in seven cases, of 35 in one; with vehicles there are three to seven a picture either way."""
BELOW_PX = 2
GROUND_PX = 6
"""How far below its foot the ground under a thing is looked at."""
MOST_SLOPE = 0.4
"""Sine of the steepest way from there to the foot."""
REACH_M = 30.0
NEARER_SHARE = 0.5
"""Of the points of a foot; their median is taken to be the near side's distance."""
SAME_FOOT = 1.1
"""Points up to so many times further away belong to the near side, too."""

GATE_M = 1.0
GATE_PER_M = 0.08
POSITION_GAIN, VELOCITY_GAIN = 0.4, 0.15
MOST_SPEED_MPS = 60.0
SEEN_BY_S = 1.0
FORGOTTEN_S = 1.0
CONFIRMED_BY = 3
SURE_BY = 4
"""Pictures that saw an object until nothing is missing from its confidence."""

Vec3 = tuple[float, float, float]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Detection:
    """A thing in one picture: its foot relative to the tile's origin, ``distance_m`` from the
    camera, and its size as the camera sees it."""

    at_m: Vec3
    distance_m: float
    width_m: float
    height_m: float


def detect(picture: LivePicture) -> list[Detection]:
    """Return what ``picture`` shows that the field does not have, from left to right."""
    if picture.trust == 0:
        return []
    found = []
    strong = picture.changed & (np.abs(picture.difference).max(axis=2) > THING_LEVELS)
    for blocks in _groups(_changed_blocks(strong)):
        if len(blocks) >= LEAST_BLOCKS:
            detection = _standing(picture, strong, blocks)
            if detection is not None:
                found.append(detection)
    return found


def _changed_blocks(changed: Mask) -> Mask:
    rows, columns = (side // BLOCK_PX for side in changed.shape)
    whole = changed[: rows * BLOCK_PX, : columns * BLOCK_PX]
    share = whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3))
    return np.asarray(share > 0.5)


def _groups(blocks: Mask) -> list[list[tuple[int, int]]]:
    """Return the (row, column) of the blocks of each 8-connected group, by leftmost block."""
    left = {(int(row), int(column)) for row, column in np.argwhere(blocks)}
    groups = []
    for first in sorted(left, key=lambda at: (at[1], at[0])):
        if first not in left:
            continue
        left.discard(first)
        group, waiting = [first], deque((first,))
        while waiting:
            row, column = waiting.popleft()
            for near in ((row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
                if near in left:
                    left.discard(near)
                    group.append(near)
                    waiting.append(near)
        groups.append(group)
    return groups


def _standing(
    picture: LivePicture, strong: Mask, blocks: Sequence[tuple[int, int]]
) -> Detection | None:
    """Return where the thing in ``blocks`` stands, None if its foot is not in the picture."""
    height = len(strong)
    own = np.zeros_like(strong)
    for row, column in blocks:  # the lower edge may be in the next block, half of it or less
        own[row * BLOCK_PX : (row + 2) * BLOCK_PX, column * BLOCK_PX : (column + 1) * BLOCK_PX] = 1
    own &= strong
    columns = np.flatnonzero(own.any(axis=0))
    if not len(columns):
        return None
    lowest = height - 1 - own[::-1, columns].argmax(axis=0)
    rows = lowest + BELOW_PX
    if (rows >= height).mean() > 0.5:
        return None
    columns, rows = columns[rows < height], rows[rows < height]
    z = picture.depth[rows, columns]
    columns, rows, z = columns[z > 0], rows[z > 0], z[z > 0]
    if not len(z):
        return None
    near = z <= SAME_FOOT * np.quantile(z, NEARER_SHARE / 2)
    u = float(columns[near].min() + columns[near].max()) / 2
    v, z_m = float(np.median(rows[near])), float(np.median(z[near]))
    k = picture.camera.intrinsics
    foot = _point(k, u, v, z_m)
    below = np.minimum(rows[near] + GROUND_PX, height - 1)
    before = _point(
        k, u, float(np.median(below)), float(np.median(picture.depth[below, columns[near]]))
    )
    to_world = picture.camera.world_from_cam.apply
    if z_m > REACH_M or _slope(to_world(before), to_world(foot)) > MOST_SLOPE:
        return None
    top = int(own.any(axis=1).argmax())
    return Detection(
        to_world(foot),
        math.hypot(*foot),
        float(np.ptp(columns) + 1) * z_m / k.fx_px,
        (v - top) * z_m / k.fy_px,
    )


def _point(k: Intrinsics, u: float, v: float, z_m: float) -> Vec3:
    """Return the point that the middle of pixel (u, v) shows, in camera axes."""
    return ((u + 0.5 - k.cx_px) / k.fx_px * z_m, (v + 0.5 - k.cy_px) / k.fy_px * z_m, z_m)


def _slope(a: Vec3, b: Vec3) -> float:
    """Return the sine of the way from a to b; 1 where there is no way."""
    length_m = math.dist(a, b)
    return abs(b[2] - a[2]) / length_m if length_m > 1e-3 else 1.0


@dataclass
class FollowedObject:
    """A thing over time. ``seen``: pictures that showed it; ``cameras``: when each saw it last."""

    object_id: int
    at_m: Vec3
    velocity_mps: Vec3
    width_m: float
    height_m: float
    first_s: float
    last_s: float
    seen: int = 1
    cameras: dict[CameraKey, float] = field(default_factory=dict)

    @property
    def is_confirmed(self) -> bool:
        """Whether enough pictures showed it."""
        return self.seen >= CONFIRMED_BY

    def confidence(self, now: float) -> float:
        """Return 0 to 1: less after few pictures, and while nobody sees it."""
        fresh = max(0.0, 1.0 - max(0.0, now - self.last_s) / FORGOTTEN_S)
        return fresh * min(1.0, self.seen / SURE_BY)

    def seen_by(self, now: float) -> list[CameraKey]:
        """Return the cameras that saw it lately, sorted."""
        return sorted(key for key, at_s in self.cameras.items() if now - at_s <= SEEN_BY_S)

    def at(self, time_s: float) -> Vec3:
        """Return where it is at a time, which may be before its last picture."""
        elapsed_s = max(-FORGOTTEN_S, min(FORGOTTEN_S, time_s - self.last_s))
        x, y, z = (
            at_m + elapsed_s * mps for at_m, mps in zip(self.at_m, self.velocity_mps, strict=True)
        )
        return x, y, z

    def take(self, detection: Detection, camera: CameraKey, time_s: float) -> None:
        """Move to what a picture of ``camera`` shows."""
        expected = self.at(time_s)
        off = [a - b for a, b in zip(detection.at_m, expected, strict=True)]
        elapsed_s = time_s - self.last_s
        gain = max(POSITION_GAIN, 1.0 / (self.seen + 1))
        x, y, z = (at_m + gain * by for at_m, by in zip(expected, off, strict=True))
        self.at_m = (x, y, z)
        if elapsed_s > 1e-3:
            vx, vy, vz = (
                mps + VELOCITY_GAIN * by / max(elapsed_s, 0.05)
                for mps, by in zip(self.velocity_mps, off, strict=True)
            )
            speed = math.hypot(vx, vy, vz)
            slower = min(1.0, MOST_SPEED_MPS / speed) if speed else 1.0
            self.velocity_mps = (slower * vx, slower * vy, slower * vz)
        self.last_s = max(self.last_s, time_s)
        self.width_m, self.height_m = detection.width_m, detection.height_m
        self.seen += 1
        self.cameras[camera] = time_s


class ObjectTracker:
    """Follows things through the pictures of all cameras of a place."""

    def __init__(self) -> None:
        self._objects: list[FollowedObject] = []
        self._next_id = 1

    def take(self, detections: Sequence[Detection], camera: CameraKey, time_s: float) -> None:
        """Take in what one picture of ``camera``, captured at ``time_s``, shows."""
        self._objects = [each for each in self._objects if time_s - each.last_s <= FORGOTTEN_S]
        pairs = sorted(
            (distance_m, each.object_id, index)
            for each in self._objects
            for index, detection in enumerate(detections)
            if (distance_m := math.dist(each.at(time_s), detection.at_m))
            <= GATE_M + GATE_PER_M * detection.distance_m
        )
        by_id = {each.object_id: each for each in self._objects}
        free = set(range(len(detections)))
        for _, object_id, index in pairs:
            if object_id in by_id and index in free:
                by_id.pop(object_id).take(detections[index], camera, time_s)
                free.discard(index)
        for index in sorted(free):
            self._begin(detections[index], camera, time_s)

    def confirmed(self, now: float) -> list[FollowedObject]:
        """Return the confirmed objects that are not forgotten, sorted by id."""
        return [
            each for each in self._objects if each.is_confirmed and now - each.last_s <= FORGOTTEN_S
        ]

    def _begin(self, detection: Detection, camera: CameraKey, time_s: float) -> None:
        begun = FollowedObject(
            self._next_id,
            detection.at_m,
            (0.0, 0.0, 0.0),
            detection.width_m,
            detection.height_m,
            time_s,
            time_s,
            cameras={camera: time_s},
        )
        self._objects.append(begun)
        self._next_id += 1
