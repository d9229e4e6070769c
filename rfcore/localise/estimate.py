"""Answers of a tracker: the state of localisation, the pose, and what happened on the way.

This needs no extra, so pipelines, metrics and logs that pass answers on do not import OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose
from rfcore.views import FieldView

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
