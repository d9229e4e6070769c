"""The camera's pose in the field, frame by frame, for the pipeline; imported only if asked for.

``rfcore.localise.tracker`` is the machine. Here it gets its measurements, and its searches a
thread: one takes several frames' time, and frames are coded meanwhile without the field. Frames
come first: the searching thread is niced, and OpenCV takes no further ones.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cav_agent.frames import Capture
from rfcore.camera import Intrinsics, Vec3
from rfcore.codec.sender.ladder import Rung
from rfcore.field import Bounds, Renderer
from rfcore.image import I420
from rfcore.localise.estimate import PoseEstimate
from rfcore.localise.localiser import Localised, Localiser, Lost
from rfcore.localise.matching import use_one_thread
from rfcore.localise.prior import PoseMeasurement
from rfcore.localise.track import TrackingBudget
from rfcore.localise.tracker import PoseTracker, SearchJob, TimedPose, full_range

__all__ = ["CameraTracking", "DatasetPoses", "Measurements"]

U8 = NDArray[np.uint8]
_Found = tuple[Localised | Lost, TimedPose | None]
"""What a search ended with, and where a later picture was taken, if that was looked for."""
DATASET_STD_M, DATASET_STD_DEG = 0.5, 1.0
"""Poses of a dataset stand in for a sensor's as good as that."""


class Measurements(Protocol):
    """Where measured poses come from."""

    def time_ns(self, capture: Capture) -> int:
        """Return when a picture was taken, on the clock of the measurements."""

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return the poses measured up to a picture's time, each once."""

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Take where a tracked picture was taken."""

    def offset_s(self) -> float | None:
        """Return what to add to the times of measurements to get the pictures', if it is known."""


class DatasetPoses:
    """The dataset's pose of each picture, for drives without a feed."""

    def time_ns(self, capture: Capture) -> int:
        """Return the time of capture."""
        return capture.capture_time_ns

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return one: of the picture itself."""
        pose = capture.picture.camera.world_from_cam
        std_m = (DATASET_STD_M,) * 3
        return [
            PoseMeasurement(
                capture.capture_time_ns, pose.translation_m, std_m, pose.rotation, DATASET_STD_DEG
            )
        ]

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Do nothing: poses of a dataset are of the pictures' times."""

    def offset_s(self) -> float | None:
        """Return None: nothing is to be learnt."""
        return None


class CameraTracking:
    """Finds one camera in one field; one caller at a time. Searches run on ``searcher``.

    ``patient``: a search is waited for, so that its frame is coded with the field; experiments,
    where no clock runs, want it. ``poses`` hears of the time and position of tracked pictures.
    """

    def __init__(
        self,
        renderer: Renderer,
        intrinsics: Intrinsics,
        poses: Measurements,
        searcher: Executor,
        *,
        bounds: Bounds | None = None,
        patient: bool = False,
    ) -> None:
        use_one_thread()
        self._tracker = PoseTracker(renderer, intrinsics, bounds=bounds)
        self._localiser: Localiser = self._tracker.localiser()
        self._poses, self._searcher = poses, searcher
        self._patient = patient
        self._running: tuple[SearchJob, Future[_Found]] | None = None
        self._newest: tuple[int, U8] | None = None

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> PoseEstimate:
        """Return what is known of a picture's pose, looked for as hard as ``rung`` says."""
        budget = TrackingBudget(rung.tracking.redraws, rung.tracking.finest_level)
        time_ns = self._poses.time_ns(capture)
        self._tracker.expect(time_ns)
        for measured in self._poses.measurements(capture):
            self._tracker.measure(measured)
        self._collect()
        self._newest = None if self._running is None else (time_ns, full_range(frame.y))
        fix = self._tracker.locate(frame, time_ns, quality=rung.quality, budget=budget)
        self._begin_search()
        if self._patient and self._running is not None:
            self._running[1].exception()
            self._collect()
            fix = self._tracker.locate(frame, time_ns, quality=rung.quality, budget=budget)
        if fix.world_from_cam is not None:
            self._poses.localised(time_ns, fix.world_from_cam.translation_m)
        return replace(fix, feed_offset_s=self._poses.offset_s())

    @property
    def counts(self) -> dict[str, int]:
        """How often what happened."""
        return {str(event): count for event, count in self._tracker.counts.items()}

    def _begin_search(self) -> None:
        if self._running is not None:
            return
        job = self._tracker.search()
        if job is not None:
            self._running = (job, self._searcher.submit(self._search, job))

    def _search(self, job: SearchJob) -> _Found:
        """Run a search, on its own thread, and look for the picture that is the newest by then."""
        answer = self._localiser.localise_luma(job.luma, job.prior)
        newest = self._newest
        if isinstance(answer, Lost) or newest is None:
            return answer, None
        return answer, job.later(answer.world_from_cam, *newest, self._localiser)

    def _collect(self) -> None:
        """Bring a search that has ended to the tracker; raise what it raised."""
        if self._running is None or not self._running[1].done():
            return
        (job, future), self._running = self._running, None
        self._tracker.searched(job, *future.result())
