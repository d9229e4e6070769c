"""Rotation vectors (exponential and logarithm of SO(3)) and interpolation of poses (SLERP).

A rotation vector points along the axis and is as long as the angle, in radians (the logarithm of
SO(3)); quaternions are w, x, y, z as in ``rfcore.camera``. Angles lie in 0..pi: of q and -q, the
same rotation, the one with w >= 0 counts. Formulas: Grassia, "Practical Parameterization of
Rotations Using the Exponential Map", J. Graphics Tools 3(3), 1998; Shoemake, "Animating Rotation
with Quaternion Curves", SIGGRAPH 1985.

Unlike ``rfcore.camera`` this uses the C library's sine and arc tangent, whose last bit may differ
between machines: send the resulting pose, not its inputs.
"""

from __future__ import annotations

import math

from rfcore.camera import Pose, Vec3
from rfcore.errors import InvalidInput

TINY_RAD = 1e-150
"""Below this angle its sine equals it, and their quotient might underflow."""

Quaternion = tuple[float, float, float, float]


def rotation_vector(rotation: Quaternion) -> Vec3:
    """Return the rotation vector [3] of a unit quaternion, of length 0..pi.

    The arc tangent of |v| / w keeps every digit near 0, where acos(w) has none, and near pi.
    At exactly pi the sign of the axis is that of the quaternion.
    """
    w, x, y, z = rotation if rotation[0] >= 0 else tuple(-value for value in rotation)
    length = math.hypot(x, y, z)
    factor = 2.0 if length < TINY_RAD else 2.0 * math.atan2(length, w) / length
    return (factor * x, factor * y, factor * z)


def quaternion_from_vector(vector_rad: Vec3) -> Quaternion:
    """Return the unit quaternion of a rotation vector [3] of any length.

    Raises ``InvalidInput`` for a vector that is not finite.
    """
    if not all(map(math.isfinite, vector_rad)):
        raise InvalidInput("rotation_vector", f"{vector_rad} must be three finite radians")
    x, y, z = vector_rad
    angle_rad = math.hypot(x, y, z)
    factor = 0.5 if angle_rad < TINY_RAD else math.sin(0.5 * angle_rad) / angle_rad
    return (math.cos(0.5 * angle_rad), factor * x, factor * y, factor * z)


def interpolated(first: Pose, second: Pose, share: float) -> Pose:
    """Return the pose ``share`` (0..1) of the way: a straight line, the shorter turn at one rate.

    The ends come back as they are. Raises ``InvalidInput`` for a share outside 0..1.
    """
    if not 0.0 <= share <= 1.0:
        raise InvalidInput("share", f"{share} is outside 0..1; extrapolation is not offered")
    if share in (0.0, 1.0):
        return second if share else first
    turned = Pose((0.0, 0.0, 0.0), first.rotation)
    between = turned.inverse().compose(Pose((0.0, 0.0, 0.0), second.rotation))
    x, y, z = rotation_vector(between.rotation)
    part = quaternion_from_vector((share * x, share * y, share * z))
    rotation = turned.compose(Pose((0.0, 0.0, 0.0), part)).rotation
    a, b = first.translation_m, second.translation_m
    tx, ty, tz = (p + share * (q - p) for p, q in zip(a, b, strict=True))
    return Pose((tx, ty, tz), rotation)
