"""The slowly varying error of measured poses, learnt while tracking and taken away while lost.

A sensor's position is the true one plus a bias that changes slowly (a lever arm measured wrongly,
the atmosphere, multipath) plus noise. While the camera is tracked the truth is known far better
than the sensor knows it, so each measurement shows bias plus noise; a Kalman filter for a random
walk, one for each axis of the world and one for each axis of the camera's rotation, keeps the bias.
A constant error is paid for once: after it was learnt, priors lie around the corrected pose.

Values: ``after`` returns the next; nothing here has a clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose
from rfcore.localise.measurement import PoseMeasurement
from rfcore.localise.prior import PosePrior
from rfcore.motion import quaternion_from_vector, rotation_vector

__all__ = ["SensorBias"]

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
    """What is known of a sensor: six axes, east, north, up in metres, then a rotation vector.

    ``value`` is the bias, ``variance`` of it; ``noise``: variance of what remains of measurements.
    Both are in units of the variances that the sensor states. Nothing known: variance 1, noise 1.
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
        """Return where the camera is by a measurement, its bias taken away.

        ``rotation``: a pose to take the rotation from where none was measured; without one there is
        no prior.
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
