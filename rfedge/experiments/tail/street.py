"""A field as the street itself: random drives through it, what a camera sees, what both ends hold.

A drive follows the cameras of a data set from its first to its last at a speed of its own, in a
lane of its own, with a sway that changes along the way. No two drives show the same pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import Quality, RadianceField, load_field
from rfcore.image import I420
from rfcore.motion import interpolated, quaternion_from_vector
from rfcore.native.yuv import i420_from_rgb
from rfedge.experiments.clips import MAX_NOISE_SIGMA, with_noise

__all__ = ["FieldStreet", "StreetDrive"]

SPEED_MPS = (4.0, 14.0)
LANE_M = 0.5
"""At most so far to either side of the recorded path."""
SWAY_M, SWAY_DEG = 0.05, 1.0
"""Of each axis, up and down over ``SWAY_S``."""
SWAY_S = (0.8, 4.0)
LEAST_FRAMES = 2


@dataclass(frozen=True)
class StreetDrive:
    """One drive: what the camera saw, and from where."""

    cameras: Sequence[Camera]
    frames: Sequence[I420]


@dataclass(frozen=True)
class FieldStreet:
    """The field ``field`` as a street, along the poses of the data set ``path``.

    ``detail``: of the level that both ends hold of it. Raises ``InvalidInput`` for a value out of
    range, and for a path of one place.
    """

    field: Path
    path: Path
    size_px: tuple[int, int]
    rate_hz: float
    detail: float
    noise_sigma: float
    seed: int

    def __post_init__(self) -> None:
        if not 0.1 <= self.rate_hz <= 120:
            raise InvalidInput("hz", f"{self.rate_hz:g} is outside 0.1..120")
        if not 0 <= self.noise_sigma <= MAX_NOISE_SIGMA:
            raise InvalidInput("noise", f"{self.noise_sigma:g} is outside 0..{MAX_NOISE_SIGMA:g}")
        if any(side % 2 for side in self.size_px):
            raise InvalidInput("size", f"{self.size_px} px must be even, for the rivals")
        Quality(detail=self.detail)

    @cached_property
    def opened(self) -> RadianceField:
        """The field."""
        return load_field(self.field)

    @property
    def held(self) -> Quality:
        """What both ends render."""
        return Quality(detail=self.detail)

    @cached_property
    def recorded(self) -> Sequence[Camera]:
        """The cameras that are driven along, of the size asked for."""
        origin = self.opened.metadata.tile_origin
        pictures = read_dataset(self.path, tile_origin=origin).pictures
        cameras = [picture.camera for picture in pictures]
        intrinsics = cameras[0].intrinsics.resized(*self.size_px)
        if self._length_m(cameras) <= 0:
            raise InvalidInput("path", f"{self.path} has the poses of one place")
        return [Camera(intrinsics, camera.world_from_cam) for camera in cameras]

    def frame_count(self, number: int) -> int:
        """Return how many frames drive ``number`` has."""
        seconds = self._length_m(self.recorded) / self._random(number).uniform(*SPEED_MPS)
        return max(LEAST_FRAMES, math.floor(seconds * self.rate_hz))

    def drive(self, number: int) -> StreetDrive:
        """Return drive ``number``, always the same."""
        cameras = self._cameras(number)
        colours = (self.opened.render_colour(camera) for camera in cameras)
        pictures = [np.floor(np.clip(c, 0, 1) * 255 + 0.5).astype(np.uint8) for c in colours]
        frames = [i420_from_rgb(picture) for picture in pictures]
        return StreetDrive(cameras, with_noise(frames, self.noise_sigma, self._key(number)))

    def _cameras(self, number: int) -> list[Camera]:
        count, random = self.frame_count(number), self._random(number)
        random.uniform(*SPEED_MPS)
        lane_m = random.uniform(-LANE_M, LANE_M)
        periods_s, phases = random.uniform(*SWAY_S, 5), random.uniform(0, 2 * np.pi, 5)
        intrinsics, cameras = self.recorded[0].intrinsics, []
        for index in range(count):
            moment_s = index / self.rate_hz
            sway = np.sin(2 * np.pi * moment_s / periods_s + phases)
            x_m, y_m = (lane_m, 0.0) + SWAY_M * sway[:2]
            turn = tuple(np.deg2rad(SWAY_DEG * sway[2:]).tolist())
            step = Pose((float(x_m), float(y_m), 0.0), quaternion_from_vector(turn))
            pose = self._along(index / (count - 1)).compose(step)
            cameras.append(_camera(intrinsics, pose))
        return cameras

    def _along(self, share: float) -> Pose:
        """Return the pose after a share of the recorded way."""
        reached_m = np.cumsum([0.0, *self._steps_m(self.recorded)])
        at_m = share * reached_m[-1]
        index = min(int(np.searchsorted(reached_m, at_m, side="right")), len(reached_m) - 1) - 1
        step_m = reached_m[index + 1] - reached_m[index]
        within = (at_m - reached_m[index]) / step_m if step_m else 0.0
        first, second = (self.recorded[index + k].world_from_cam for k in range(2))
        return interpolated(first, second, min(1.0, float(within)))

    @staticmethod
    def _steps_m(cameras: Sequence[Camera]) -> list[float]:
        places = (camera.world_from_cam.translation_m for camera in cameras)
        return [math.dist(a, b) for a, b in pairwise(places)]

    def _length_m(self, cameras: Sequence[Camera]) -> float:
        return sum(self._steps_m(cameras))

    def _key(self, number: int) -> tuple[int, int]:
        return self.seed, number

    def _random(self, number: int) -> np.random.Generator:
        return np.random.default_rng(self._key(number))


def _camera(intrinsics: Intrinsics, pose: Pose) -> Camera:
    return Camera(intrinsics, pose).rounded()
