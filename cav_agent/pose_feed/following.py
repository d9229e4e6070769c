"""The camera where a feed says that it is: measured poses carried on at the last velocity.

For vehicles that do not look for their pose in the field. GNSS is metres off, so what is coded at
these poses is as good as the feed: of an RTK receiver with an inertial unit, say.
"""

from __future__ import annotations

import math

from cav_agent.frames import Capture
from cav_agent.pose_feed.checks import FASTEST_MPS, NS
from cav_agent.pose_feed.feed import FieldFeed
from rfcore.camera import Camera, Pose, Vec3
from rfcore.errors import RfedgeError
from rfcore.localise.prior import PoseMeasurement, PosePrior

__all__ = ["FollowedFeed"]

LONGEST_CARRY_S = 2.0
"""A velocity is carried on for so long; then the camera is held where it would be."""
LEAST_STD_M, LEAST_STD_DEG = 0.05, 0.1
LONGEST_STEP_S = 5.0
"""Two poses further apart say nothing about the velocity."""


class FollowedFeed:
    """Poses of the camera for captured pictures; one caller at a time."""

    def __init__(self, feed: FieldFeed, *, recorded: bool, rate_hz: float) -> None:
        self._feed, self._recorded, self._rate_hz = feed, recorded, rate_hz
        self._last: PoseMeasurement | None = None
        self._rotation: tuple[float, float, float, float] | None = None
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._until_ns = 0

    def time_ns(self, capture: Capture) -> int:
        """Return a picture's time on the feed's clock: of the drive for a recorded feed."""
        if not self._recorded:
            return capture.capture_time_ns
        return capture.picture.time_ns or round(capture.index / self._rate_hz * NS)

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return the poses measured up to a picture's time, each once; of a recorded feed again
        when the drive begins again."""
        time_ns = self.time_ns(capture)
        if self._recorded and time_ns < self._until_ns:
            self._feed.restart()
            self._last = None
        self._until_ns = time_ns
        return self._feed.measurements(time_ns)

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Take where the field says that the camera was: it tells how late the feed is."""
        self._feed.localised(time_ns, position_m)

    def offset_s(self) -> float | None:
        """Return what to add to the feed's times, s; None where the drive does not tell."""
        offset = self._feed.time_offset()
        return None if offset is None else offset.seconds

    def camera(self, capture: Capture) -> Camera:
        """Return the picture's camera at its measured pose, rounded as it is sent.

        Raises ``RfedgeError`` while the feed has not yet said where the camera is.
        """
        intrinsics = capture.picture.camera.intrinsics
        return Camera(intrinsics, self.prior(capture).world_from_cam).rounded()

    def prior(self, capture: Capture) -> PosePrior:
        """Return what is known of a picture's pose, with its standard deviations; raises alike.

        Of the three axes of the position the middle deviation counts: a height is often unknown.
        """
        time_ns = self.time_ns(capture)
        for measured in self.measurements(capture):
            self._take(measured)
        last = self._last
        if last is None or self._rotation is None:
            raise RfedgeError("the pose feed has not said where the camera is")
        carried_s = min((time_ns - last.time_ns) / NS, LONGEST_CARRY_S)
        x, y, z = (p + carried_s * v for p, v in zip(last.position_m, self._velocity, strict=True))
        pose = Pose((x, y, z), self._rotation)
        position_m = max(sorted(last.position_std_m)[1], LEAST_STD_M)
        return PosePrior(pose, position_m, max(last.rotation_std_deg, LEAST_STD_DEG))

    def _take(self, measured: PoseMeasurement) -> None:
        last, self._last = self._last, measured
        self._rotation = measured.rotation or self._rotation
        self._velocity = (0.0, 0.0, 0.0)
        if last is None:
            return
        step_s = (measured.time_ns - last.time_ns) / NS
        if 0 < step_s <= LONGEST_STEP_S:
            a, b = last.position_m, measured.position_m
            x, y, z = ((q - p) / step_s for p, q in zip(a, b, strict=True))
            if math.hypot(x, y, z) <= FASTEST_MPS:  # more is a jump, not a velocity
                self._velocity = (x, y, z)
