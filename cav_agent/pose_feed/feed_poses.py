"""The camera's poses in one field as a pose feed measures them.

``FeedPoses`` puts the fixes of a ``PoseFeed`` into a field's axes, each once. A vehicle that looks
for its pose in the field takes them as measurements. For others, the last pose is extrapolated at
the last velocity; GNSS is metres off, so what is coded at these poses is as good as the feed (an
RTK receiver with an inertial unit, say).

``TimeOffsetEstimator`` finds how late a feed's times are against the camera's, from the poses that
the field gave. A fix stamped t that was the vehicle's position at t + tau lies off the true path by
about velocity * tau; a bias adds the same everywhere. Over fixes with errors e and velocities v,

    e = bias + v tau + noise,

the least-squares tau is sum w (v - mean v)(e - mean e) / sum w (v - mean v)^2, along each axis with
the weights w of its variances: a height that is unknown says nothing. It is known as far as the
velocity has changed, in size or direction. Old fixes are forgotten.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from cav_agent.camera_poses import PoseSource
from cav_agent.frames import Capture
from cav_agent.pose_feed.feed import FASTEST_MPS, NS, SIGMAS, PoseFeed
from cav_agent.pose_feed.fix import FeedProblem, FieldPlacement, Fix
from rfcore.camera import Camera, Pose, Vec3
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import Bounds
from rfcore.localise.estimate import PoseMeasurement, PosePrior
from rfcore.views import PosedPicture

KEPT = 300
FEWEST = 8
DETERMINED_S = 0.1
"""A larger standard deviation says nothing."""
LONGEST_GAP_S = 1.0
"""Longest time between poses of the field that a fix is compared with."""
MARGIN_M = 50.0
"""A position is outside a field's bounds if it is this, and ``SIGMAS`` deviations, beyond them."""
LONGEST_CARRY_S = 2.0
"""A pose is extrapolated for so long; then the camera is held where it would be."""
LEAST_STD_M, LEAST_STD_DEG = 0.05, 0.1
LONGEST_STEP_S = 5.0
"""Two poses further apart say nothing about the velocity."""


@dataclass(frozen=True)
class TimeOffset:
    """Add ``seconds`` to a feed's times to get the camera's; one sigma ``std_s``."""

    seconds: float
    std_s: float


class TimeOffsetEstimator:
    """Compares where the camera was with what the feed said of that."""

    def __init__(self) -> None:
        self._path: deque[tuple[float, Vec3]] = deque(maxlen=KEPT)
        self._pairs: deque[tuple[Vec3, Vec3, Vec3]] = deque(maxlen=KEPT)
        """Errors, velocities and standard deviations."""
        self._waiting: deque[tuple[float, Vec3, Vec3]] = deque(maxlen=KEPT)

    def localised(self, time_s: float, position_m: Vec3) -> None:
        """Take a position the field gave; raise ``InvalidInput`` for time that goes back."""
        if self._path and time_s <= self._path[-1][0]:
            raise InvalidInput("time_s", f"{time_s} is not after {self._path[-1][0]}")
        self._path.append((time_s, position_m))
        while self._waiting and self._waiting[0][0] <= time_s:
            self._compare(*self._waiting.popleft())

    def measured(self, time_s: float, position_m: Vec3, std_m: Vec3) -> None:
        """Take a position the feed gave, compared as soon as the path has come so far."""
        self._waiting.append((time_s, position_m, std_m))

    def offset(self) -> TimeOffset | None:
        """Return the offset, None while the drive does not determine it to 0.1 s."""
        if len(self._pairs) < FEWEST:
            return None
        pairs = np.array(self._pairs)
        weights = pairs[:, 2] ** -2
        errors, velocities = (
            values - np.average(values, axis=0, weights=weights)
            for values in (pairs[:, 0], pairs[:, 1])
        )
        change = float((weights * velocities**2).sum())
        if change <= 0.0:
            return None
        seconds = float((weights * velocities * errors).sum()) / change
        noise = float((weights * (errors - seconds * velocities) ** 2).sum())
        std_s = math.sqrt(noise / (3 * len(pairs) - 4) / change)
        return TimeOffset(seconds, std_s) if std_s <= DETERMINED_S else None

    def _compare(self, time_s: float, position_m: Vec3, std_m: Vec3) -> None:
        times = [at_s for at_s, _ in self._path]
        after = bisect_right(times, time_s)
        after = after - 1 if after == len(times) and times[-1] == time_s else after
        if not 0 < after < len(times) or times[after] - times[after - 1] > LONGEST_GAP_S:
            return
        (begin_s, a), (end_s, b) = self._path[after - 1], self._path[after]
        share = (time_s - begin_s) / (end_s - begin_s)
        velocity = [(q - p) / (end_s - begin_s) for p, q in zip(a, b, strict=True)]
        error = [z - p - share * (q - p) for z, p, q in zip(position_m, a, b, strict=True)]
        self._pairs.append(
            ((error[0], error[1], error[2]), (velocity[0], velocity[1], velocity[2]), std_m)
        )


def recorded_time_ns(picture: PosedPicture, index: int, rate_hz: float) -> int:
    """Return when picture ``index`` of a drive was taken; at ``rate_hz`` where it has no time."""
    return picture.time_ns or round(index / rate_hz * NS)


class FeedPoses(PoseSource):
    """Poses of the camera for captured pictures, by a feed; one caller at a time.

    ``bounds``: of the field; ``None``: anywhere. ``rate_hz``: of a drive without times.
    """

    def __init__(
        self,
        feed: PoseFeed,
        placement: FieldPlacement,
        bounds: Bounds | None = None,
        *,
        rate_hz: float = 10.0,
    ) -> None:
        self._feed, self._placement, self._bounds = feed, placement, bounds
        self._rate_hz = rate_hz
        self._number = 0
        self._waiting: deque[tuple[Fix, int]] = deque()
        self._estimator = TimeOffsetEstimator()
        self._last: PoseMeasurement | None = None
        self._rotation: tuple[float, float, float, float] | None = None
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._until_ns = 0

    def time_ns(self, capture: Capture) -> int:
        """Return a picture's time on the feed's clock: a recorded feed has that of the drive."""
        if not self._feed.recorded:
            return capture.capture_time_ns
        return recorded_time_ns(capture.picture, capture.index, self._rate_hz)

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return the poses measured up to a picture's time, each once, in order."""
        return self.measurements_until(self.time_ns(capture))

    def measurements_until(self, until_ns: int) -> list[PoseMeasurement]:
        """Return the poses measured up to a time of the camera's clock, each once, in order.

        A recorded feed is read again when the time goes back: the drive begins again.
        """
        if self._feed.recorded and until_ns < self._until_ns:
            self._number = 0
            self._waiting.clear()
            self._last = None
        self._until_ns = until_ns
        new, self._number = self._feed.since(self._number)
        self._waiting.extend(new)
        found = []
        while self._waiting and self._waiting[0][1] <= until_ns:
            measurement = self._measurement(*self._waiting.popleft())
            if measurement is not None:
                found.append(measurement)
        return found

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Take where the field says that the camera was: it shows how late the feed is."""
        try:
            self._estimator.localised(time_ns / NS, position_m)
        except InvalidInput:
            self._estimator = TimeOffsetEstimator()  # a drive begins again

    def offset_s(self) -> float | None:
        """Return what to add to the feed's times, s; None where the drive does not show it."""
        offset = self.time_offset()
        return None if offset is None else offset.seconds

    def time_offset(self) -> TimeOffset | None:
        """Return what to add to the feed's times; None where the drive does not show it."""
        return self._estimator.offset()

    def camera(self, capture: Capture) -> Camera:
        """Return the picture's camera at its measured pose, rounded as it is sent.

        Raises ``RfedgeError`` while the feed has not yet said where the camera is.
        """
        intrinsics = capture.picture.camera.intrinsics
        return Camera(intrinsics, self.prior(self.time_ns(capture)).world_from_cam).rounded()

    def prior(self, time_ns: int) -> PosePrior:
        """Return what is known of the pose at a time, with its standard deviations; raises alike.

        The middle one of the position's three deviations counts: a height is often unknown.
        """
        for measured in self.measurements_until(time_ns):
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

    def _measurement(self, fix: Fix, time_ns: int) -> PoseMeasurement | None:
        try:
            measurement = self._placement.measurement(fix, time_ns)
        except InvalidInput as error:
            no_anchor = fix.geodetic is not None and self._placement.anchor is None
            problem = FeedProblem.NO_ANCHOR if no_anchor else FeedProblem.NOT_FINITE
            self._feed.problems.note(problem, str(error), time_ns)
            return None
        if not self._is_inside(measurement):
            where = ", ".join(f"{value:.0f}" for value in measurement.position_m)
            text = f"({where}) m is beyond the field's bounds"
            self._feed.problems.note(FeedProblem.OUTSIDE, text, time_ns)
            return None
        self._estimator.measured(time_ns / NS, measurement.position_m, measurement.position_std_m)
        return measurement

    def _is_inside(self, measurement: PoseMeasurement) -> bool:
        if self._bounds is None:
            return True
        corners = zip(self._bounds.low_m, self._bounds.high_m, strict=True)
        axes = zip(measurement.position_m, measurement.position_std_m, corners, strict=True)
        return all(
            low - MARGIN_M - SIGMAS * std <= at <= high + MARGIN_M + SIGMAS * std
            for at, std, (low, high) in axes
        )
