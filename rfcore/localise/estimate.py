"""Inputs and outputs of a tracker: measurements and priors; states and poses.

This needs no extra, so pipelines, metrics and logs that pass answers on do not import OpenCV.

A feed turns whatever a sensor says (satellite navigation, a compass, a dataset's poses) into
``PoseMeasurement``, in the axes of the field's tile and of the camera, on the camera's clock. The
tracker (``rfcore.localise.tracker``) uses measurements as priors, never as poses to send.

Vehicles know their pose to metres and degrees. Features of a picture are found again in a render
that was made some way off, so few renders cover such a prior: the pose itself first, then rings of
poses around it, the nearest first. How far off a render may be depends on how far away the scene
is: a picture changes with the ratio of the movement to the depth. The distance between rings
therefore is a share of the scene's median depth, and nothing here depends on the unit of length of
the field.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, Vec3
from rfcore.errors import InvalidInput
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import FieldView

MAX_TIME_NS = 1 << 64
REACH_OF_DEPTH = 0.25
"""Distance between rings, as a share of the scene's median depth."""
REACH_DEG = 12.0
"""Yaw between hypotheses; of a field of view of 60 degrees or more, four fifths stay in view."""
MOST_RINGS = 3
MOST_TURNS = 2
"""Limits of rings, and of turns to each side: never more than 185 hypotheses."""
AROUND = 6
"""Poses of the innermost ring; the n-th has n times as many."""
PLAUSIBLE = 4.0
"""Standard deviations that a pose may lie from the prior; more refutes it."""


@dataclass(frozen=True)
class PoseMeasurement:
    """A measured pose of the camera; standard deviations are one sigma.

    Raises ``InvalidInput`` for values that are not finite, a quaternion that is not a unit one, a
    deviation that is not above 0, or a time outside uint64.
    """

    time_ns: int
    """Time of the pose, nanoseconds of the Unix epoch."""
    position_m: Vec3
    """Position of the camera's centre in the tile's frame: east, north, up."""
    position_std_m: Vec3
    """Standard deviations of east, north and up."""
    rotation: tuple[float, float, float, float] | None = None
    """world_from_cam, w, x, y, z; ``None`` where no direction was measured."""
    rotation_std_deg: float = 5.0
    """Standard deviation of the rotation, mostly of the heading; unused without a rotation."""

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


@dataclass(frozen=True)
class PosePrior:
    """A pose, and the standard deviations of its position (per axis, m) and rotation (degrees).

    The camera is taken to stand upright, as on a vehicle: errors along its right and forward axes
    and of its yaw are searched; what remains, height, pitch and roll, must be small.
    Raises ``InvalidInput`` for a deviation that is not finite or not above 0.
    """

    world_from_cam: Pose
    position_m: float
    rotation_deg: float

    def __post_init__(self) -> None:
        for name in ("position_m", "rotation_deg"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidInput(f"prior.{name}", f"{value} must be finite and above 0")

    def allows(self, world_from_cam: Pose) -> bool:
        """Return whether a pose lies within four standard deviations in position and rotation."""
        difference = self.world_from_cam.inverse().compose(world_from_cam)
        turned_deg = math.degrees(math.hypot(*rotation_vector(difference.rotation)))
        far_m = math.hypot(*difference.translation_m)
        return far_m <= PLAUSIBLE * self.position_m and turned_deg <= PLAUSIBLE * self.rotation_deg


def moved(world_from_cam: Pose, by_m: Vec3, turn_rad: Vec3 = (0.0, 0.0, 0.0)) -> Pose:
    """Return a pose moved by ``by_m`` and turned by a rotation vector, both in camera axes."""
    return world_from_cam.compose(Pose(by_m, quaternion_from_vector(turn_rad)))


def hypotheses(prior: PosePrior, median_depth_m: float) -> Iterator[Pose]:
    """Yield the poses to render at, the prior's own first.

    ``median_depth_m`` is that of the render at the prior, 0 where the field shows nothing there.
    Rings reach as far as the standard deviation of the position, turns as far as that of the
    rotation, as far as ``MOST_RINGS`` and ``MOST_TURNS`` let them.
    """
    reach_m = max(REACH_OF_DEPTH * median_depth_m, prior.position_m / MOST_RINGS)
    rings = min(math.ceil(prior.position_m / reach_m), MOST_RINGS)
    turns = min(int(prior.rotation_deg / REACH_DEG), MOST_TURNS)
    yaws_rad = [math.radians(REACH_DEG * n) for n in sorted(range(-turns, turns + 1), key=abs)]
    for ring in range(rings + 1):
        for right_m, forward_m in _ring(ring, reach_m):
            for yaw_rad in yaws_rad:
                yield moved(prior.world_from_cam, (right_m, 0.0, forward_m), (0.0, yaw_rad, 0.0))


def _ring(number: int, reach_m: float) -> Iterator[tuple[float, float]]:
    """Yield (right_m, forward_m) of one ring, evenly spaced, starting straight ahead."""
    count = max(AROUND * number, 1)
    for step in range(count):
        angle = 2 * math.pi * step / count
        yield number * reach_m * math.sin(angle), number * reach_m * math.cos(angle)


F64 = NDArray[np.float64]


class LocalisationState(StrEnum):
    """State of a camera's localisation."""

    LOST = "lost"
    LOCALISING = "localising"
    TRACKING = "tracking"


class TrackerEvent(StrEnum):
    """Kinds of events that a tracker counts."""

    MEASURED = "measured"
    """A measurement was used."""
    BACKWARDS = "backwards"
    """A measurement that is not newer than the one before it was ignored."""
    JUMPED = "jumped"
    """A measurement was further from a good track than its errors allow."""
    OFF_TIME = "off_time"
    """The newest measurement is from another time than the picture: silence, or a wrong clock."""
    OUTSIDE = "outside"
    """A measurement far outside the field was ignored."""
    TIME_REVERSED = "time_reversed"
    """A picture was taken before the one before it: the track was given up."""
    SEARCHED = "searched"
    """A search was begun."""
    FOUND = "found"
    """A search ended with a pose."""
    NOT_FOUND = "not_found"
    """A search ended without one."""
    TRACK_LOST = "track_lost"
    """A picture was not where the track led, or too long after the one before it."""
    TRACKED = "tracked"
    """A picture's pose was found and passed the check."""
    REDRAWN = "redrawn"
    """The field was rendered more than once for a tracked picture."""


@dataclass(frozen=True)
class MeasurementError:
    """Distance of a measurement from the pose found; degrees where a rotation was measured."""

    metres: float
    degrees: float | None


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The pose of one picture, as far as it is known.

    ``view`` shows the field at the pose to send, while tracking. ``covariance`` [6, 6] is in metres
    and radians in the camera's axes. ``correction`` compares the pose with the measurement of its
    time, where there is one. ``inliers`` are those of the last search that found a pose.
    ``correction_px`` is how far off the pose still is. ``renders`` counts those made for this
    picture. ``feed_offset_s`` is to be added to the sensor's times to get the pictures', where the
    motion tells.
    """

    state: LocalisationState
    time_ns: int
    view: FieldView | None = None
    covariance: F64 | None = None
    agreement: float = 0.0
    inliers: int | None = None
    correction: MeasurementError | None = None
    correction_px: float = 0.0
    renders: int = 0
    feed_offset_s: float | None = None

    @property
    def world_from_cam(self) -> Pose | None:
        """The pose to send; ``None`` unless tracking."""
        return None if self.view is None else self.view.camera.world_from_cam
