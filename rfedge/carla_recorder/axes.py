"""From CARLA's left-handed axes to ours.

CARLA (Unreal) has x forward, y right, z up, in the world as in a sensor, which looks along its x;
``Transform.get_matrix`` is world_from_sensor. Our world is the same with y negated, p = S p_carla
with S = diag(1, -1, 1), so that it is right-handed with z up. A camera's OpenCV axes are right = y,
down = -z, forward = x of the sensor, the columns of P below, hence R = S R_carla P.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from rfcore.camera import Intrinsics, Pose
from rfcore.errors import InvalidInput

__all__ = ["intrinsics_of_fov", "point_from_carla", "pose_from_carla"]


def pose_from_carla(world_from_sensor: Sequence[Sequence[float]]) -> Pose:
    """Return world_from_cam of a sensor's 4x4 ``Transform.get_matrix()``.

    Raises ``InvalidInput`` when it is not rigid; its float32 entries are well within tolerance.
    """
    rows = []
    for sign, (x, y, z, t) in zip((1.0, -1.0, 1.0), world_from_sensor[:3], strict=True):
        rows.append([sign * y, -sign * z, sign * x, sign * t])
    return Pose.from_matrix(rows)


def point_from_carla(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of CARLA's world in ours."""
    return (x, -y, z)


def intrinsics_of_fov(width_px: int, height_px: int, fov_deg: float) -> Intrinsics:
    """Return the intrinsics of ``sensor.camera.rgb``: horizontal field of view, square pixels."""
    if not 0 < fov_deg < 180:
        raise InvalidInput("fov_deg", f"{fov_deg} is outside 0..180 degrees")
    focal_px = width_px / (2 * math.tan(math.radians(fov_deg) / 2))
    return Intrinsics(width_px, height_px, focal_px, focal_px, width_px / 2, height_px / 2)
