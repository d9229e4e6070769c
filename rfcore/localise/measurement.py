"""What a sensor says of the camera's pose: satellite navigation, a compass, a dataset's poses.

A feed turns whatever it reads into ``PoseMeasurement``, in the axes of the field's tile and of the
camera; the tracker (``rfcore.localise.tracker``) uses them as priors, never as poses to send.
Times are those of the camera's clock: a feed's offset is taken away before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rfcore.camera import Pose, Vec3
from rfcore.errors import InvalidInput

__all__ = ["PoseMeasurement"]

MAX_TIME_NS = 1 << 64


@dataclass(frozen=True)
class PoseMeasurement:
    """One measured pose of the camera; standard deviations are one sigma.

    Raises ``InvalidInput`` for values that are not finite, a quaternion that is not a unit one, a
    deviation that is not above 0, or a time outside uint64.
    """

    time_ns: int
    """When the camera was there, nanoseconds of the Unix epoch."""
    position_m: Vec3
    """Of the camera's centre, in the tile's frame: east, north, up."""
    position_std_m: Vec3
    """Of east, north and up."""
    rotation: tuple[float, float, float, float] | None = None
    """world_from_cam, w, x, y, z; ``None`` where no direction was measured."""
    rotation_std_deg: float = 5.0
    """Of the rotation, mostly the heading's; of no meaning without a rotation."""

    def __post_init__(self) -> None:
        if not 0 <= self.time_ns < MAX_TIME_NS:
            raise InvalidInput("measurement.time_ns", f"{self.time_ns} is outside 0..2**64 - 1")
        Pose(self.position_m, self.rotation or (1.0, 0.0, 0.0, 0.0))
        for name, values in (
            ("position_std_m", self.position_std_m),
            ("rotation_std_deg", (self.rotation_std_deg,)),
        ):
            if not all(math.isfinite(value) and value > 0 for value in values):
                raise InvalidInput(
                    f"measurement.{name}", f"{values} must be finite and above 0, one sigma"
                )

    @property
    def world_from_cam(self) -> Pose | None:
        """The whole pose; ``None`` without a rotation."""
        return None if self.rotation is None else Pose(self.position_m, self.rotation)
