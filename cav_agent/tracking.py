"""Finds a camera's pose in the field, frame by frame; imported only if that is asked for.

``rfcore.localise.tracker`` decides. Here it gets its measurements, and its searches run on a thread
of their own: a search takes the time of several frames, which are coded without the field
meanwhile. Frames come first: the searching thread is niced, and OpenCV takes no further ones.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cav_agent.camera_poses import CameraLocation, PoseSource
from cav_agent.frames import Capture
from rfcore.camera import Intrinsics
from rfcore.codec.sender.ladder import Rung
from rfcore.field import Bounds, Renderer
from rfcore.image import I420
from rfcore.localise.localiser import Localised, Localiser, Lost
from rfcore.localise.matching import use_one_thread
from rfcore.localise.track import TrackingBudget
from rfcore.localise.tracker import PoseTracker, SearchJob, TimedPose, full_range

U8 = NDArray[np.uint8]
SearchResult = tuple[Localised | Lost, TimedPose | None]
"""The end of a search, and the pose of a later picture, if that was searched for."""


class CameraTracking:
    """Finds one camera in one field; one caller at a time. Searches run on ``searcher``.

    ``patient``: a search is waited for, so that its frame is coded with the field, as experiments
    want it where no clock runs. ``source`` learns the time and position of tracked pictures.
    """

    def __init__(
        self,
        renderer: Renderer,
        intrinsics: Intrinsics,
        source: PoseSource,
        searcher: Executor,
        *,
        bounds: Bounds | None = None,
        patient: bool = False,
    ) -> None:
        use_one_thread()
        self._tracker = PoseTracker(renderer, intrinsics, bounds=bounds)
        self._localiser: Localiser = self._tracker.localiser()
        self._source, self._searcher = source, searcher
        self._patient = patient
        self._running: tuple[SearchJob, Future[SearchResult]] | None = None
        self._newest: tuple[int, U8] | None = None

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:
        """Return where a picture was taken, looked for within the budget of ``rung``."""
        budget = TrackingBudget(rung.tracking.redraws, rung.tracking.finest_level)
        time_ns = self._source.time_ns(capture)
        self._tracker.expect(time_ns)
        for measured in self._source.measurements(capture):
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
            self._source.localised(time_ns, fix.world_from_cam.translation_m)
        fix = replace(fix, feed_offset_s=self._source.offset_s())
        camera = None if fix.view is None else fix.view.camera
        return CameraLocation(camera, fix.world_from_cam, fix.state, fix, fix.view)

    @property
    def counts(self) -> dict[str, int]:
        """Return how often each event happened."""
        return {str(event): count for event, count in self._tracker.counts.items()}

    def _begin_search(self) -> None:
        if self._running is not None:
            return
        job = self._tracker.search()
        if job is not None:
            self._running = (job, self._searcher.submit(self._search, job))

    def _search(self, job: SearchJob) -> SearchResult:
        """Run a search, on its own thread, and locate the picture that is the newest by then."""
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
