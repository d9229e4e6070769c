"""The vertical of a world, and the views of its cameras, taken from the cameras' poses.

A dataset may have any right-handed axes: z is up in ENU, y in OpenGL, -y where the first camera's
axes are the world's. People and cars hold cameras upright, so that up is the mean of the cameras'
upward axes (-y in OpenCV's). Where cameras look steeply down or are held on their side it is not.

What assumes an upright frame works in one turned by ``upright_from``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose, Vec3
from rfcore.errors import InvalidInput

Z_UP: Vec3 = (0.0, 0.0, 1.0)
AGREES_RAD, LEAST_AGREEING = math.radians(60), 0.75
"""Angle to the mean within which a camera agrees with it, and the share of cameras that must."""
SAME_RAD = math.radians(10)
"""A mean this near to z is z: cameras that look a little down, one way, lean it."""
UNIT_TOLERANCE = 1e-3
LEAST_SPREAD, AIMED_RAD, MOST_OFF_RAD = 0.03, math.radians(20), math.radians(60)
"""Cameras look at one point if their axes differ (least eigenvalue of the normal equations for the
point, for each camera), half of them aim at it this well, and all of them this badly."""
MOST_SIGHTS = 64
KEPT_SIGHTS, DECIMALS = 8, 4

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Sight:
    """A camera's place and the unit vector along which it looks.

    Raises ``InvalidInput`` for values that are not finite, or a vector whose length is not 1.
    """

    eye_m: Vec3
    towards: Vec3

    def __post_init__(self) -> None:
        if len(self.eye_m) != 3 or not all(map(math.isfinite, self.eye_m)):
            raise InvalidInput("sight.eye_m", f"{self.eye_m} must be three finite metres")
        check_direction("sight.towards", self.towards)


def check_direction(name: str, direction: Vec3) -> None:
    """Raise ``InvalidInput`` unless ``direction`` is a unit vector, within 0.001."""
    if len(direction) != 3 or not abs(math.hypot(*direction) - 1) <= UNIT_TOLERANCE:
        raise InvalidInput(name, f"{direction} must be a vector of length 1")


def vertical_of(poses: Iterable[Pose]) -> Vec3 | None:
    """Return up in the world of ``poses`` (world_from_cam), None where they do not agree on it.

    They agree if ``LEAST_AGREEING`` of them are upright within ``AGREES_RAD`` of the mean; the
    others do not count.

    >>> level = Pose.from_matrix([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    >>> vertical_of([level]), vertical_of([Pose.identity()])
    ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    """
    ups = -np.array([pose.rotation_matrix() for pose in poses]).reshape(-1, 3, 3)[:, :, 1]
    mean = _unit(ups.sum(axis=0))
    agree = ups @ mean > math.cos(AGREES_RAD)
    if not len(ups) or agree.mean() < LEAST_AGREEING:
        return None
    mean = _unit(ups[agree].sum(axis=0))
    return Z_UP if mean[2] > math.cos(SAME_RAD) else _rounded(mean)


def sights_of(cameras: Sequence[Camera]) -> tuple[Sight, ...]:
    """Return the sights of ``KEPT_SIGHTS`` cameras at most, evenly spread over ``cameras``."""
    count = min(KEPT_SIGHTS, len(cameras))
    spread = np.linspace(0, len(cameras) - 1, count).round().astype(int)
    poses = [cameras[index].world_from_cam for index in spread]
    axes = [np.array(pose.rotation_matrix())[:, 2] for pose in poses]
    pairs = zip(poses, axes, strict=True)
    return tuple(Sight(_rounded(pose.translation_m), _rounded(axis)) for pose, axis in pairs)


def seen_point(sights: Sequence[Sight]) -> F64 | None:
    """Return the point that cameras look at, None where there is none: nearest to all axes."""
    if len(sights) < 3:
        return None
    eyes, axes = _arrays(sights)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < LEAST_SPREAD * len(sights):
        return None
    point = np.linalg.solve(normal, (across @ eyes[:, :, None]).sum(axis=0)[:, 0])
    cosines = _cosines(sights, point)
    aimed = np.median(cosines) > math.cos(AIMED_RAD) and cosines.min() > math.cos(MOST_OFF_RAD)
    return np.asarray(point) if aimed else None


def first_sight(sights: Sequence[Sight]) -> Sight | None:
    """Return where to begin to look at a field: at the camera that aims best at what all look at,
    else at the middle one; None without any."""
    point = seen_point(sights)
    if point is not None:
        return sights[int(np.argmax(_cosines(sights, point)))]
    return sights[len(sights) // 2] if sights else None


def _arrays(sights: Sequence[Sight]) -> tuple[F64, F64]:
    """Return places and axes, [N, 3] each."""
    return np.array([s.eye_m for s in sights]), np.array([s.towards for s in sights])


def _cosines(sights: Sequence[Sight], point: F64) -> F64:
    """Return the cosines [N] of the angles between the cameras' axes and the ways to a point."""
    eyes, axes = _arrays(sights)
    ways = point - eyes
    return np.asarray((ways * axes).sum(axis=1) / np.maximum(np.linalg.norm(ways, axis=1), 1e-9))


def upright_from(up: Vec3) -> Pose:
    """Return the shortest rotation that turns ``up`` into z; the identity where it is z."""
    x, y, z = (value / math.hypot(*up) for value in up)
    if z < -1 + 1e-9:
        return Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
    norm = math.sqrt(2 * (1 + z))
    return Pose((0.0, 0.0, 0.0), (norm / 2, y / norm, -x / norm, 0.0))


def direction(vector: Vec3) -> str:
    """Return a unit vector as text: an axis by its name, as ``-y``, within a degree.

    >>> direction((0.0, -1.0, 0.0)), direction((0.6, 0.0, 0.8))
    ('-y', '(0.60, 0.00, 0.80)')
    """
    largest = max(range(3), key=lambda axis: abs(vector[axis]))
    if abs(vector[largest]) > math.cos(math.radians(1)):
        return ("-" if vector[largest] < 0 else "") + "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in vector) + ")"


def _unit(vector: F64) -> F64:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def _rounded(values: Iterable[float]) -> Vec3:
    x, y, z = (round(float(value), DECIMALS) + 0.0 for value in values)
    return x, y, z
