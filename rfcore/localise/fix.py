"""What a tracker answers: a camera's state, its pose, and what happened. Needs no extra.

So whoever passes answers on (pipelines, metrics, logs) does not import OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose
from rfcore.views import FieldView

__all__ = ["Correction", "Event", "Fix", "State"]

F64 = NDArray[np.float64]


class State(StrEnum):
    """What is known of the camera's pose."""

    LOST = "lost"
    LOCALISING = "localising"
    TRACKING = "tracking"


class Event(StrEnum):
    """One kind of thing that happened."""

    MEASURED = "measured"
    """A measurement was taken in."""
    BACKWARDS = "backwards"
    """A measurement not newer than the one before it was left out."""
    JUMPED = "jumped"
    """A measurement departed from a good track by more than its errors allow."""
    OFF_TIME = "off_time"
    """The newest measurement is from another time than the picture: silence, or a wrong clock."""
    OUTSIDE = "outside"
    """A measurement far outside the field was left out."""
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
class Correction:
    """How far a pose is from a measurement of its time; degrees where a rotation was measured."""

    metres: float
    degrees: float | None


@dataclass(frozen=True, eq=False)
class Fix:
    """What is known of the pose of one picture.

    ``view``: the field at the pose to send, rounded as ever; only while tracking. ``covariance``
    [6, 6]: metres and radians in the camera's axes. ``correction``: how far the pose is from the
    measurement of its time, where there is one. ``inliers``: of the last search that found a pose.
    ``correction_px``: how far off the pose still is. ``renders``: made for this picture.
    ``feed_offset_s``: add to the sensor's times to get the pictures', where the motion tells.
    """

    state: State
    time_ns: int
    view: FieldView | None = None
    covariance: F64 | None = None
    agreement: float = 0.0
    inliers: int | None = None
    correction: Correction | None = None
    correction_px: float = 0.0
    renders: int = 0
    feed_offset_s: float | None = None

    @property
    def world_from_cam(self) -> Pose | None:
        """The pose to send; ``None`` unless tracking."""
        return None if self.view is None else self.view.camera.world_from_cam
