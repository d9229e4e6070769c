"""Measurements of a feed so far: the newest one, the sensor's bias, and where to search.

Times may run backwards, poses may jump or lie outside the field: each is counted, none is followed
blindly. A jump is believed when it is repeated.

The slowly varying error of measured poses is learnt while tracking and taken away while lost. A
sensor's position is the true one plus a bias that changes slowly (a lever arm measured wrongly,
the atmosphere, multipath) plus noise. While the camera is tracked, its pose is known far better
than the sensor knows it, so each measurement shows bias plus noise; a Kalman filter for a random
walk, one for each axis of the world and one for each axis of the camera's rotation, keeps the bias.
Once a constant error was learnt, priors lie around the corrected pose.

``SensorBias`` is a value: ``after`` returns the next one. Nothing here has a clock.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose
from rfcore.field import Bounds
from rfcore.localise.estimate import MeasurementError, PoseMeasurement, PosePrior, TrackerEvent
from rfcore.localise.track import Motion, Track
from rfcore.motion import quaternion_from_vector, rotation_vector

F64 = NDArray[np.float64]

WALK_PER_ROOT_S = 0.25
"""Growth of the bias's standard deviation in a second, in stated standard deviations: one that is
stationary at the stated value, with a correlation time of 30 s, walks that far."""
NOISE_MEMORY = 0.8
"""Weight of what was known of the noise when a measurement was taken in."""
LEAST_OF_STATED = 0.1
"""A sensor is never believed to be more than ten times as good as it says."""
NOTHING: tuple[float, ...] = (0.0,) * 6


@dataclass(frozen=True)
class SensorBias:
    """Error of a sensor along six axes: east, north, up in metres, then a rotation vector.

    ``value`` is the bias and ``variance`` that of its estimate; ``noise`` is the variance of what
    remains of measurements. Both variances are in units of those that the sensor states; 1 stands
    for nothing known.
    """

    value: tuple[float, ...] = NOTHING
    variance: tuple[float, ...] = (1.0,) * 6
    noise: tuple[float, ...] = (1.0,) * 6
    time_ns: int | None = None

    def at(self, time_ns: int) -> SensorBias:
        """Return what is known of it at a later time: less."""
        if self.time_ns is None or time_ns <= self.time_ns:
            return self
        grown = WALK_PER_ROOT_S**2 * (time_ns - self.time_ns) / 1e9
        variance = tuple(min(variance + grown, 1.0) for variance in self.variance)
        return replace(self, variance=variance, time_ns=time_ns)

    def after(self, measured: PoseMeasurement, tracked: Pose) -> SensorBias:
        """Return the bias once a measurement was compared with the pose tracked at its time."""
        before = self.at(measured.time_ns)
        stated = _stated(measured)
        shown = _shown(measured, tracked)
        axes = 6 if measured.rotation is not None else 3
        value, variance, noise = list(before.value), list(before.variance), list(before.noise)
        for axis in range(axes):
            surprise = (shown[axis] - value[axis]) / stated[axis]
            share = variance[axis] / (variance[axis] + noise[axis])
            seen = surprise**2 * (1 - share)
            value[axis] += share * surprise * stated[axis]
            variance[axis] *= 1 - share
            noise[axis] = max(
                NOISE_MEMORY * noise[axis] + (1 - NOISE_MEMORY) * min(seen, 1.0),
                LEAST_OF_STATED**2,
            )
        return SensorBias(tuple(value), tuple(variance), tuple(noise), measured.time_ns)

    def surprise(self, measured: PoseMeasurement, tracked: Pose) -> float:
        """Return by how many stated standard deviations a position departs from what is known."""
        shown, stated = _shown(measured, tracked), _stated(measured)
        at = self.at(measured.time_ns)
        return max(
            abs(shown[axis] - at.value[axis])
            / (stated[axis] * max(1.0, math.sqrt(at.variance[axis] + at.noise[axis])))
            for axis in range(3)
        )

    def prior(self, measured: PoseMeasurement, rotation: Pose | None) -> PosePrior | None:
        """Return where the camera is by a measurement, with the bias taken away.

        Where no rotation was measured it is that of the pose ``rotation``; without both there is no
        prior.
        """
        at = self.at(measured.time_ns)
        stated = _stated(measured)
        spread = [
            math.sqrt(variance + noise) * sigma
            for variance, noise, sigma in zip(at.variance, at.noise, stated, strict=True)
        ]
        x, y, z = (p - b for p, b in zip(measured.position_m, at.value[:3], strict=True))
        if measured.rotation is not None:
            turn = Pose((0.0, 0.0, 0.0), quaternion_from_vector(_vec3(at.value[3:])))
            facing = Pose((0.0, 0.0, 0.0), measured.rotation).compose(turn.inverse())
        elif rotation is not None:
            facing = rotation
        else:
            return None
        position_m = max(spread[0], spread[1])
        rotation_deg = max(math.degrees(max(spread[3:])), 0.1)
        return PosePrior(Pose((x, y, z), facing.rotation), position_m, rotation_deg)


def _stated(measured: PoseMeasurement) -> list[float]:
    """Return the standard deviations [6] that the sensor states, metres and radians."""
    return [*measured.position_std_m, *[math.radians(measured.rotation_std_deg)] * 3]


def _shown(measured: PoseMeasurement, tracked: Pose) -> list[float]:
    """Return measured less tracked [6]: metres in the world, a rotation vector in the camera."""
    moved = [a - b for a, b in zip(measured.position_m, tracked.translation_m, strict=True)]
    if measured.rotation is None:
        return [*moved, 0.0, 0.0, 0.0]
    was = Pose((0.0, 0.0, 0.0), tracked.rotation).inverse()
    turn = was.compose(Pose((0.0, 0.0, 0.0), measured.rotation))
    return [*moved, *rotation_vector(turn.rotation)]


def _vec3(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


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
"""Speed at which an old measurement widens the search where no motion is known."""
OUTSIDE_M = 50.0
"""A measurement further than this outside the field's bounds is no place to search."""
LEAST_M, LEAST_DEG = 0.3, 1.5
"""Priors are never taken for better: the search refuses a pose four deviations from its prior."""


class MeasuredPoses:
    """The feed of one camera; ``counts`` is shared with the tracker."""

    def __init__(self, counts: Counter[TrackerEvent], bounds: Bounds | None) -> None:
        self._counts, self._bounds = counts, bounds
        self.newest: PoseMeasurement | None = None
        self.bias = SensorBias()
        self._jumps = 0

    def take(self, measured: PoseMeasurement, track: Track | None) -> None:
        """Take in a measurement, and what it shows of the bias while there is a track."""
        last = self.newest
        if last is not None and measured.time_ns <= last.time_ns:
            self._counts[TrackerEvent.BACKWARDS] += 1
            return
        if self._is_outside(measured):
            self._counts[TrackerEvent.OUTSIDE] += 1
            return
        self._counts[TrackerEvent.MEASURED] += 1
        self.newest = measured
        if track is not None:
            self._learn(measured, track)

    def forget(self) -> None:
        """Give up the newest measurement: its time means nothing any more. The bias stays."""
        self.newest = None

    def prior(
        self, time_ns: int, motion: Motion | None, facing: Pose | None, widened: float
    ) -> PosePrior | None:
        """Return where the camera is expected at ``time_ns``; ``None`` where nothing tells.

        ``facing`` takes the place of a rotation that was not measured. ``widened`` is a factor of
        the standard deviations.
        """
        measured = self.newest
        if measured is None:
            return None
        age_s = (time_ns - measured.time_ns) / 1e9
        if abs(age_s) > OLDEST_S:
            self._counts[TrackerEvent.OFF_TIME] += 1
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

    def correction(self, time_ns: int, found: Pose) -> MeasurementError | None:
        """Return how far a pose is from the newest measurement, if that is of the same time."""
        measured = self.newest
        if measured is None or abs(measured.time_ns - time_ns) > SAME_TIME_NS:
            return None
        metres = math.dist(measured.position_m, found.translation_m)
        if measured.rotation is None:
            return MeasurementError(metres, None)
        was = Pose((0.0, 0.0, 0.0), measured.rotation).inverse()
        turn = was.compose(Pose((0.0, 0.0, 0.0), found.rotation))
        return MeasurementError(metres, math.degrees(math.hypot(*rotation_vector(turn.rotation))))

    def _learn(self, measured: PoseMeasurement, track: Track) -> None:
        if abs(measured.time_ns - track.time_ns) > 1e9 * COMPARED_S:
            return
        there = track.predicted(measured.time_ns)
        if self.bias.time_ns is not None and self.bias.surprise(measured, there) > JUMP:
            self._counts[TrackerEvent.JUMPED] += 1
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
