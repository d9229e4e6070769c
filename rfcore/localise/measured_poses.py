"""What a feed has said so far: the newest measurement, the sensor's bias, and where to search.

Times may run backwards, poses may jump or lie outside the field: each is counted, none is followed
blindly. A jump is believed when it is repeated. While tracking, every measurement shows the bias.
"""

from __future__ import annotations

import math
from collections import Counter

from rfcore.camera import Pose
from rfcore.field import Bounds
from rfcore.localise.fix import Correction, Event
from rfcore.localise.measurement import PoseMeasurement
from rfcore.localise.prior import PosePrior
from rfcore.localise.sensor_bias import SensorBias
from rfcore.localise.track import Motion, Track
from rfcore.motion import rotation_vector

__all__ = ["UNKNOWN_SPEED_M_S", "MeasuredPoses"]

JUMP = 6.0
"""A measurement so many standard deviations from where it should be has jumped."""
BELIEVED_JUMPS = 3
"""So many in a row are a new bias, not outliers."""
OLDEST_S = 3.0
"""A measurement further than this from the picture's time tells nothing of where it was taken."""
COMPARED_S = 1.5
"""A measurement further than this from the last tracked picture shows no bias."""
SAME_TIME_NS = 50_000_000
UNKNOWN_SPEED_M_S = 10.0
"""Where no motion is known, an old measurement widens the search so fast."""
OUTSIDE_M = 50.0
"""A measurement further than this outside the field's bounds is no place to search."""
LEAST_M, LEAST_DEG = 0.3, 1.5
"""Priors are never taken for better: the search refuses a pose four deviations from its prior."""


class MeasuredPoses:
    """The feed of one camera; ``counts`` is shared with the tracker."""

    def __init__(self, counts: Counter[Event], bounds: Bounds | None) -> None:
        self._counts, self._bounds = counts, bounds
        self.newest: PoseMeasurement | None = None
        self.bias = SensorBias()
        self._jumps = 0

    def take(self, measured: PoseMeasurement, track: Track | None) -> None:
        """Take in a measurement, and what it shows of the bias while there is a track."""
        last = self.newest
        if last is not None and measured.time_ns <= last.time_ns:
            self._counts[Event.BACKWARDS] += 1
            return
        if self._is_outside(measured):
            self._counts[Event.OUTSIDE] += 1
            return
        self._counts[Event.MEASURED] += 1
        self.newest = measured
        if track is not None:
            self._learn(measured, track)

    def forget(self) -> None:
        """Give up the newest measurement: its time means nothing any more. The bias stays."""
        self.newest = None

    def prior(
        self, time_ns: int, motion: Motion | None, facing: Pose | None, widened: float
    ) -> PosePrior | None:
        """Return where a camera is expected at ``time_ns``; ``None`` where nothing tells.

        ``facing``: takes the place of a rotation that was not measured. ``widened``: factor of the
        standard deviations.
        """
        measured = self.newest
        if measured is None:
            return None
        age_s = (time_ns - measured.time_ns) / 1e9
        if abs(age_s) > OLDEST_S:
            self._counts[Event.OFF_TIME] += 1
            return None
        prior = self.bias.prior(measured, facing)
        if prior is None:
            return None
        moved = Pose.identity() if motion is None else motion.over(age_s)
        unknown_m = UNKNOWN_SPEED_M_S * abs(age_s) if motion is None else 0.0
        return PosePrior(
            prior.world_from_cam.compose(moved),
            widened * (max(prior.position_m, LEAST_M) + unknown_m),
            widened * max(prior.rotation_deg, LEAST_DEG),
        )

    def correction(self, time_ns: int, found: Pose) -> Correction | None:
        """Return how far a pose is from the newest measurement, if that is of the same time."""
        measured = self.newest
        if measured is None or abs(measured.time_ns - time_ns) > SAME_TIME_NS:
            return None
        metres = math.dist(measured.position_m, found.translation_m)
        if measured.rotation is None:
            return Correction(metres, None)
        was = Pose((0.0, 0.0, 0.0), measured.rotation).inverse()
        turn = was.compose(Pose((0.0, 0.0, 0.0), found.rotation))
        return Correction(metres, math.degrees(math.hypot(*rotation_vector(turn.rotation))))

    def _learn(self, measured: PoseMeasurement, track: Track) -> None:
        if abs(measured.time_ns - track.time_ns) > 1e9 * COMPARED_S:
            return
        there = track.predicted(measured.time_ns)
        if self.bias.time_ns is not None and self.bias.surprise(measured, there) > JUMP:
            self._counts[Event.JUMPED] += 1
            self._jumps += 1
            if self._jumps < BELIEVED_JUMPS:
                return
            self.bias = SensorBias()
        self._jumps = 0
        self.bias = self.bias.after(measured, there)

    def _is_outside(self, measured: PoseMeasurement) -> bool:
        bounds = self._bounds
        if bounds is None:
            return False
        sides = zip(bounds.low_m, measured.position_m, bounds.high_m, strict=True)
        return not all(low - OUTSIDE_M <= at <= high + OUTSIDE_M for low, at, high in sides)
