"""Track a camera's pose from picture to picture: Lost -> Localising -> Tracking, or lost again.

A machine without clock, threads or I/O. Every picture is handed over with its capture time; what
sensors measured is handed over as it comes. The answer to a picture is a ``PoseEstimate``: the
field as rendered at the pose to send, or that the pose is not known.

* *Lost*: there is no track, and nothing tells where to search, or a search has just failed.
* *Localising*: a search (``rfcore.localise.localiser``) is to be run or is running. The machine
  hands out a ``SearchJob``; its driver runs the job when and where it likes and brings the answer
  back (``searched``). By then newer pictures have come: the pose found is carried forward by what
  is known of the motion and aligned with the next picture. Where no motion is known, the driver
  also looks for the newest picture, from the pose found, which is soon done.
* *Tracking*: each picture is predicted, aligned and checked (``rfcore.localise.track``). The check
  is of the render at the very pose to be sent; a pose that does not pass is never sent.

Measured poses are priors of searches, never poses to send. While tracking, the sensor's bias is
learnt (``rfcore.localise.measured_poses``), so that a constant error is paid for once.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import FULL, Bounds, Quality, Renderer, render_field_view
from rfcore.image import I420
from rfcore.localise.alignment import Expected
from rfcore.localise.estimate import (
    LocalisationState,
    PoseEstimate,
    PoseMeasurement,
    PosePrior,
    TrackerEvent,
)
from rfcore.localise.localiser import Localised, Localiser, Lost
from rfcore.localise.matching import Pyramid
from rfcore.localise.measured_poses import UNKNOWN_SPEED_M_S, MeasuredPoses
from rfcore.localise.track import (
    LONGEST_GAP_S,
    Motion,
    RenderAt,
    Track,
    TrackingBudget,
    begin_track,
    follow_track,
)
from rfcore.views import FieldView

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

LONGEST_PAUSE_S = 4.0
"""Between searches that fail one after another."""
FIRST_PAUSE_S = 0.1
LEAST_BETWEEN_S = 0.01
"""Poses nearer in time show no motion."""
CARRY_OF_MOTION = 0.3
"""Share of the motion since a search's picture that carrying its pose forward may be wrong by."""
CARRY_ALIGNMENTS = 2
"""Alignments of a pose carried forward: it is further off than a prediction, and frames wait."""
RECENT_S = 3.0
"""A pose known so long ago still tells where to search."""
RECENT_M, RECENT_DEG, RECENT_DEG_PER_S = 0.5, 1.5, 4.0
"""Error of the expected pose of a camera that was just seen: one sigma, and its growth."""


ONE_MORE_RENDER = TrackingBudget(1)


@dataclass(frozen=True)
class TimedPose:
    """A pose of the camera at a time."""

    time_ns: int
    world_from_cam: Pose


@dataclass(frozen=True, eq=False)
class SearchJob:
    """A search to be run: ``Localiser.localise_luma(luma, prior)``, then ``PoseTracker.searched``.

    Where the camera's ``motion`` is not known, a pose that was found says little about the pictures
    taken meanwhile, and whoever runs the job looks where a later one was taken (``later``).
    """

    number: int
    time_ns: int
    luma: U8
    prior: PosePrior
    motion: Motion | None = None

    def later(self, found: Pose, time_ns: int, luma: U8, localiser: Localiser) -> TimedPose | None:
        """Return where a picture was taken later than the job's, in which the camera was found.

        None where the motion is known already, or it was not found.
        """
        if self.motion is not None or time_ns <= self.time_ns:
            return None
        prior = _expected_since(TimedPose(self.time_ns, found), None, time_ns)
        pose = localiser.again(luma, prior)
        return None if pose is None else TimedPose(time_ns, pose)


class PoseTracker:
    """Follows one camera in one field, for one caller at a time.

    ``counts`` says how often each event happened. Measurements far outside the field's ``bounds``
    are ignored, if they are given.
    """

    def __init__(
        self,
        renderer: Renderer,
        intrinsics: Intrinsics,
        bounds: Bounds | None = None,
    ) -> None:
        self._renderer, self._intrinsics = renderer, intrinsics
        self.counts: Counter[TrackerEvent] = Counter()
        self.state = LocalisationState.LOST
        self.feed = MeasuredPoses(self.counts, bounds)
        self._time_ns: int | None = None
        self._track: Track | None = None
        self._found: TimedPose | None = None
        self._seen: TimedPose | None = None
        self._motion: Motion | None = None
        self._inliers: int | None = None
        self._job: SearchJob | None = None
        self._handed_out = False
        self._searches, self._failures, self._pause_until_ns = 0, 0, 0

    def localiser(self, quality: Quality = FULL) -> Localiser:
        """Return what runs the search jobs; it may be used on another thread."""
        return Localiser(self._renderer, self._intrinsics, quality=quality)

    def expect(self, time_ns: int) -> None:
        """The next picture is of this time; measurements after an earlier one belong to it."""
        if self._time_ns is not None and time_ns < self._time_ns:
            self.counts[TrackerEvent.TIME_REVERSED] += 1
            self._forget()
        self._time_ns = time_ns

    def measure(self, measured: PoseMeasurement) -> None:
        """Take in what a sensor measured; the newest counts."""
        self.feed.take(measured, self._track)

    def locate(
        self,
        frame: I420,
        time_ns: int,
        *,
        quality: Quality = FULL,
        budget: TrackingBudget = ONE_MORE_RENDER,
    ) -> PoseEstimate:
        """Return what is known of the pose of a picture taken at ``time_ns``.

        A picture of an earlier time than the last begins anew.
        """
        self.expect(time_ns)
        levels = Pyramid(frame.y)
        render_at = partial(self._render_at, quality)
        track = self._followed(levels, time_ns, render_at, budget)
        if track is None:
            track = self._carried(levels, time_ns, render_at)
        if track is not None:
            return self._tracking(track)
        self._want_search(frame, time_ns)
        self.state = LocalisationState.LOST if self._job is None else LocalisationState.LOCALISING
        return PoseEstimate(self.state, time_ns, inliers=self._inliers)

    def search(self) -> SearchJob | None:
        """Return the search to be run, once; ``None`` while there is none to begin."""
        if self._job is None or self._handed_out:
            return None
        self._handed_out = True
        self.counts[TrackerEvent.SEARCHED] += 1
        return self._job

    def searched(
        self, job: SearchJob, answer: Localised | Lost, later: TimedPose | None = None
    ) -> None:
        """Take in what a search found, and where the camera was ``later``, if that was looked for.

        An answer to a job that was given up is ignored.
        """
        if self._job is None or job.number != self._job.number:
            return
        self._job, self._handed_out = None, False
        if isinstance(answer, Lost):
            self.counts[TrackerEvent.NOT_FOUND] += 1
            self._failed(job.time_ns)
            return
        self.counts[TrackerEvent.FOUND] += 1
        self._failures, self._inliers = 0, answer.solution.inliers
        self._found = TimedPose(job.time_ns, answer.world_from_cam)
        self._note(self._found)
        if later is not None:
            self._found = later
            self._note(later)

    def _render_at(self, quality: Quality, pose: Pose) -> FieldView:
        camera = Camera(self._intrinsics, pose).rounded()
        return render_field_view(self._renderer, camera, quality)

    def _followed(
        self,
        levels: Pyramid,
        time_ns: int,
        render_at: RenderAt,
        budget: TrackingBudget,
    ) -> Track | None:
        track = self._track
        if track is None:
            return None
        found = None
        if 0 < time_ns - track.time_ns <= 1e9 * LONGEST_GAP_S:
            found = follow_track(track, time_ns, levels, render_at, budget)
        if found is None:
            self.counts[TrackerEvent.TRACK_LOST] += 1
            self._track = None
        return found

    def _carried(self, levels: Pyramid, time_ns: int, render_at: RenderAt) -> Track | None:
        """Return the track that begins with a pose found in an earlier picture, or in this one."""
        found, self._found = self._found, None
        if found is None or time_ns - found.time_ns > 1e9 * LONGEST_GAP_S:
            return None
        seconds = (time_ns - found.time_ns) / 1e9
        if seconds == 0:
            return begin_track(time_ns, found.world_from_cam, None, levels, render_at)
        moved = (self._motion or Motion()).over(seconds)
        speed_m_s = math.hypot(*moved.translation_m) / seconds
        off_m = CARRY_OF_MOTION * seconds * (speed_m_s if self._motion else UNKNOWN_SPEED_M_S)
        expected = Expected(RECENT_M / 2 + off_m, math.radians(RECENT_DEG))
        near = found.world_from_cam.compose(moved)
        track = begin_track(time_ns, near, expected, levels, render_at, CARRY_ALIGNMENTS)
        if track is None:
            self._motion = None  # it led elsewhere: the next search learns it anew
        return track

    def _tracking(self, track: Track) -> PoseEstimate:
        self.counts[TrackerEvent.TRACKED] += 1
        self.counts[TrackerEvent.REDRAWN] += track.renders > 1
        self._job, self._handed_out, self._found = None, False, None
        self._failures, self._pause_until_ns = 0, 0
        self._note(TimedPose(track.time_ns, track.world_from_cam))
        self._motion = track.motion or self._motion
        self._track = track if track.motion else replace(track, motion=self._motion)
        self.state = LocalisationState.TRACKING
        return PoseEstimate(
            LocalisationState.TRACKING,
            track.time_ns,
            track.view,
            track.covariance,
            track.agreement,
            self._inliers,
            self.feed.correction(track.time_ns, track.world_from_cam),
            track.correction_px,
            track.renders,
        )

    def _failed(self, time_ns: int) -> None:
        """Wait before the next search, longer each time; the first failure is tried again."""
        self._failures += 1
        if self._failures > 1:
            pause_s = min(FIRST_PAUSE_S * 2 ** min(self._failures, 10), LONGEST_PAUSE_S)
            self._pause_until_ns = time_ns + round(1e9 * pause_s)
        if self._track is None:
            self.state = LocalisationState.LOST

    def _want_search(self, frame: I420, time_ns: int) -> None:
        """Prepare a search with this picture unless one is under way or nothing tells where."""
        if self._handed_out or time_ns < self._pause_until_ns:
            return
        prior = self._prior(time_ns)
        self._job = None
        if prior is not None:
            self._searches += 1
            self._job = SearchJob(self._searches, time_ns, full_range(frame.y), prior, self._motion)

    def _prior(self, time_ns: int) -> PosePrior | None:
        """Return where to search: where the camera was just seen, unless the feed contradicts."""
        recent = self._recent(time_ns)
        facing = None if self._seen is None else self._seen.world_from_cam
        widened = 2.0 ** min(self._failures, 2)
        measured = self.feed.prior(time_ns, self._motion, facing, widened)
        if recent is None or measured is None:
            return recent or measured
        believed = self._failures == 0 and measured.allows(recent.world_from_cam)
        return recent if believed else measured

    def _recent(self, time_ns: int) -> PosePrior | None:
        """Return where the camera is expected that was seen a moment ago."""
        seen = self._seen
        if seen is None or not 0 <= time_ns - seen.time_ns <= 1e9 * RECENT_S:
            return None
        return _expected_since(seen, self._motion, time_ns)

    def _note(self, seen: TimedPose) -> None:
        """Remember where the camera was, and learn its motion from two poses of near times.

        A camera that is where it cannot have driven to was not seen between: its motion is kept.
        """
        last, self._seen = self._seen, seen
        if last is None:
            return
        seconds = (seen.time_ns - last.time_ns) / 1e9
        if not LEAST_BETWEEN_S < seconds <= RECENT_S:
            return
        if _expected_since(last, self._motion, seen.time_ns).allows(seen.world_from_cam):
            self._motion = Motion.between(last.world_from_cam, seen.world_from_cam, seconds)

    def _forget(self) -> None:
        """Give up everything that depends on the order of time; the sensor's bias stays."""
        self._track = self._found = self._motion = self._seen = self._job = None
        self._handed_out, self._failures, self._pause_until_ns = False, 0, 0
        self.feed.forget()


def _expected_since(seen: TimedPose, motion: Motion | None, time_ns: int) -> PosePrior:
    """Return where a camera is expected that was seen a moment before."""
    seconds = (time_ns - seen.time_ns) / 1e9
    moved = (motion or Motion()).over(seconds)
    off_m = RECENT_M + CARRY_OF_MOTION * math.hypot(*moved.translation_m)
    if motion is None:
        off_m += UNKNOWN_SPEED_M_S * seconds
    off_deg = RECENT_DEG + RECENT_DEG_PER_S * seconds
    return PosePrior(seen.world_from_cam.compose(moved), off_m, off_deg)


def full_range(luma: U8) -> U8:
    """Return luma of limited range, 16..235, stretched to 0..255, as features are looked for in."""
    return _STRETCHED[luma]


_STRETCHED: U8 = np.clip((np.arange(256) - 16.0) * 255 / 219 + 0.5, 0, 255).astype(np.uint8)
