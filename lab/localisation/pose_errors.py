"""Models of errors of a vehicle's own poses: white noise, constant offset, GNSS.

A sensor observes the true pose at instants of its own, adds its errors, and hands each observation
over some time later. Three errors add up:

* white noise: independent from observation to observation;
* offset: one displacement and turn, drawn once and held, as of a lever arm measured wrongly;
* bias walk: a first-order Gauss-Markov process per axis, stationary with standard deviation
  ``walk_m`` and correlation time ``walk_s`` (Brown and Hwang, "Introduction to Random Signals and
  Applied Kalman Filtering", section 3.9), as of the atmosphere and multipath of GNSS.

Displacements and turns are in the axes of the camera, but those of offset and walk in the axes of
the first camera, so that they stay the same in the world while the vehicle turns. Offset and walk
are mostly horizontal: their share along the camera's y axis, downwards, is ``ASIDE``.
All chance comes from the generator that is handed over: the same seed gives the same observations.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, Vec3
from rfcore.errors import InvalidInput
from rfcore.motion import interpolated, quaternion_from_vector
from rfedge.located import Observation

F64 = NDArray[np.float64]

ASIDE = 0.1
"""Vertical share of offset and bias walk, and share of an offset's turn that is not yaw."""
LEAST_SD_M, LEAST_SD_DEG = 0.01, 0.01
"""Least standard deviations that an observation states: a sensor without error has them, too."""


@dataclass(frozen=True)
class PoseErrorModel:
    """Errors, rate, latency and silence of a sensor of poses; all 0: the true poses.

    Raises ``InvalidInput`` for a value that is negative or not finite.
    """

    noise_m: float = 0.0
    """White noise, standard deviation per axis."""
    noise_deg: float = 0.0
    """White noise of the rotation vector, standard deviation per axis."""
    offset_m: float = 0.0
    """Length of the constant displacement."""
    offset_deg: float = 0.0
    """Angle of the constant turn."""
    walk_m: float = 0.0
    """Stationary standard deviation of the bias walk, per horizontal axis."""
    walk_s: float = 30.0
    """Correlation time of the bias walk."""
    rate_hz: float = 0.0
    """Observations a second; 0: one at each true pose."""
    latency_s: float = 0.0
    """Time from the observed instant until the observation is handed over."""
    silent_from_s: float = 0.0
    """Nothing is observed from so long after the first pose on,"""
    silent_s: float = 0.0
    """for so long."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value >= 0):
                raise InvalidInput(f"pose_errors.{item.name}", f"{value} must be finite and >= 0")
        if self.walk_m and not self.walk_s:
            raise InvalidInput("pose_errors.walk_s", "must be above 0 where walk_m is")

    @property
    def position_sd_m(self) -> float:
        """Standard deviation of a position, per horizontal axis, as the sensor would state it."""
        spread_m = math.sqrt(self.noise_m**2 + self.walk_m**2 + self.offset_m**2)
        return max(spread_m, LEAST_SD_M)

    @property
    def rotation_sd_deg(self) -> float:
        """Standard deviation of the rotation, as the sensor would state it."""
        return max(math.hypot(self.noise_deg, self.offset_deg), LEAST_SD_DEG)


ERROR_MODELS = {
    "exact": PoseErrorModel(),
    "white-small": PoseErrorModel(noise_m=0.2, noise_deg=0.5),
    "white-large": PoseErrorModel(noise_m=0.5, noise_deg=1.0),
    "offset": PoseErrorModel(offset_m=0.75, offset_deg=0.5),
    "gnss": PoseErrorModel(
        noise_m=0.3, noise_deg=1.0, walk_m=1.5, walk_s=30.0, rate_hz=1.0, latency_s=0.2
    ),
}
"""Sensors by name. ``gnss``: metres of slowly moving bias, one fix a second, a compass."""


def parse_error_model(text: str) -> PoseErrorModel:
    """Return the error model of ``NAME`` or ``NAME,KEY=VALUE,...`` or ``KEY=VALUE,...``.

    Names are those of ``ERROR_MODELS``, keys the attributes of ``PoseErrorModel``. Raises
    ``InvalidInput`` for others and for values that are no numbers.
    """
    first, _, rest = text.partition(",")
    values = dict(vars(ERROR_MODELS["exact"]))
    if "=" in first:
        rest = text
    elif first in ERROR_MODELS:
        values = dict(vars(ERROR_MODELS[first]))
    else:
        raise InvalidInput("errors", f"'{first}' is none of {', '.join(ERROR_MODELS)}")
    for item in filter(None, rest.split(",")):
        key, _, number = item.partition("=")
        if key not in values:
            raise InvalidInput("errors", f"'{key}' is none of {', '.join(values)}")
        try:
            values[key] = float(number)
        except ValueError as error:
            raise InvalidInput("errors", f"{key}: '{number}' is not a number") from error
    return PoseErrorModel(**values)


def observed(
    times_s: Sequence[float],
    poses: Sequence[Pose],
    model: PoseErrorModel,
    rng: np.random.Generator,
) -> list[Observation]:
    """Return what a sensor with the errors of ``model`` observes of true poses at ``times_s``.

    Between true poses they are interpolated. Silence takes observations away and changes no other.
    Raises ``InvalidInput`` unless there is a time for each pose, at least one, and times increase.
    """
    _check(times_s, poses)
    taken_s = _instants(times_s, model.rate_hz)
    shifts_m = _slow_shifts(taken_s, model, rng)
    offset = _offset_turn(model, rng)
    noises = rng.normal(size=(len(taken_s), 2, 3)) * [[model.noise_m], [model.noise_deg]]
    first = Pose((0.0, 0.0, 0.0), poses[0].rotation)
    at = _path(times_s, poses)
    silent_from_s = times_s[0] + model.silent_from_s
    observations = []
    for time_s, shift_m, (noise_m, noise_deg) in zip(taken_s, shifts_m, noises, strict=True):
        if silent_from_s <= time_s < silent_from_s + model.silent_s:
            continue
        slow = Pose(_sum(at(time_s).translation_m, first.apply(shift_m)), at(time_s).rotation)
        turn = quaternion_from_vector(_vector(np.deg2rad(noise_deg)))
        pose = slow.compose(Pose(_vector(noise_m), turn)).compose(offset)
        known_s = time_s + model.latency_s
        observations.append(
            Observation(time_s, known_s, pose, model.position_sd_m, model.rotation_sd_deg)
        )
    return observations


def _check(times_s: Sequence[float], poses: Sequence[Pose]) -> None:
    if not poses or len(times_s) != len(poses):
        raise InvalidInput("poses", f"{len(times_s)} times for {len(poses)} poses; at least one")
    if not all(a < b for a, b in pairwise(times_s)):
        raise InvalidInput("times_s", "must increase")


def _instants(times_s: Sequence[float], rate_hz: float) -> list[float]:
    """Return when a pose is observed: at each true pose, or at a rate of the sensor's own."""
    if not rate_hz:
        return list(times_s)
    count = int((times_s[-1] - times_s[0]) * rate_hz + 1e-9) + 1
    return [min(times_s[0] + n / rate_hz, times_s[-1]) for n in range(count)]


def _slow_shifts(taken_s: Sequence[float], model: PoseErrorModel, rng: np.random.Generator) -> F64:
    """Return offset and bias walk [N, 3] in metres, in the axes of the first camera."""
    heading = rng.uniform(0.0, 2 * math.pi)
    way = np.array([math.sin(heading), ASIDE * rng.normal(), math.cos(heading)])
    offset_m = model.offset_m * way / np.linalg.norm(way)
    steps = rng.normal(size=(len(taken_s), 3)) * [1.0, ASIDE, 1.0]
    walk = steps.copy()
    for n in range(1, len(walk)):
        kept = math.exp(-(taken_s[n] - taken_s[n - 1]) / model.walk_s) if model.walk_m else 0.0
        walk[n] = kept * walk[n - 1] + math.sqrt(1 - kept * kept) * steps[n]
    shifts: F64 = offset_m + model.walk_m * walk
    return shifts


def _offset_turn(model: PoseErrorModel, rng: np.random.Generator) -> Pose:
    """Return the constant turn of the camera, mostly a yaw."""
    axis = np.array([ASIDE * rng.normal(), rng.choice([-1.0, 1.0]), ASIDE * rng.normal()])
    turn = math.radians(model.offset_deg) * axis / np.linalg.norm(axis)
    return Pose((0.0, 0.0, 0.0), quaternion_from_vector(_vector(turn)))


def _path(times_s: Sequence[float], poses: Sequence[Pose]) -> Callable[[float], Pose]:
    """Return the pose at any time between the first and the last."""

    def at(time_s: float) -> Pose:
        after = min(bisect_right(times_s, time_s), len(times_s) - 1)
        before = max(after - 1, 0)
        if before == after:
            return poses[0]
        share = (time_s - times_s[before]) / (times_s[after] - times_s[before])
        return interpolated(poses[before], poses[after], min(max(share, 0.0), 1.0))

    return at


def _sum(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _vector(values: F64) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)
