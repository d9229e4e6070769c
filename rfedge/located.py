"""Find the pictures of a drive in a field, from what a sensor says of their poses.

This drives ``rfcore.localise.tracker`` in one process, where no clock runs: a search is run at once
and its answer is used for the very picture.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from rfcore.camera import Pose
from rfcore.field import RadianceField
from rfcore.image import I420
from rfcore.localise.estimate import PoseEstimate, PoseMeasurement
from rfcore.localise.tracker import PoseTracker
from rfcore.views import FieldView, PosedPicture
from rfedge.arguments import ASSUMED_HZ

NS = 1e9
OWN_SD_M, OWN_SD_DEG = 0.01, 0.01
"""Standard deviations that a dataset's own poses state; the tracker takes no sensor for so good."""


@dataclass(frozen=True)
class Observation:
    """The pose of the camera at ``taken_s`` as a sensor saw it, handed over at ``known_s``.

    Standard deviations are per axis, metres and degrees, as the sensor states them.
    """

    taken_s: float
    known_s: float
    world_from_cam: Pose
    position_sd_m: float
    rotation_sd_deg: float


@dataclass(frozen=True)
class TimedFix:
    """The pose estimate of a picture, and the processor time of this process that it took.

    ``search_cpu_ms`` is 0 where no search was run.
    """

    fix: PoseEstimate
    track_cpu_ms: float
    search_cpu_ms: float


class LocatedDrive:
    """Finds the pictures of a drive, in their order.

    The sensor runs before the first picture: its first observation is known then, whatever its
    latency. Times of ``observations`` are on the clock of ``times_of``.
    """

    def __init__(
        self,
        field: RadianceField,
        pictures: Sequence[PosedPicture],
        observations: Sequence[Observation],
    ) -> None:
        in_order = sorted(observations, key=lambda observation: observation.known_s)
        self._waiting = deque(in_order)
        times_s = times_of(pictures)
        self._times_ns = {p.name: round(NS * t) for p, t in zip(pictures, times_s, strict=True)}
        self._tracker = PoseTracker(field, pictures[0].camera.intrinsics, bounds=field.bounds)
        self._localiser = self._tracker.localiser()
        self._heard = False
        self.fixes: list[TimedFix] = []

    def locate(self, picture: PosedPicture, frame: I420) -> FieldView | None:
        """Return what the field shows where ``frame`` was taken; ``None`` if that is not known."""
        time_ns = self._times_ns[picture.name]
        self._listen(time_ns / NS)
        begun_s = time.process_time()
        fix = self._tracker.locate(frame, time_ns)
        tracked_s = time.process_time()
        job = self._tracker.search()
        searched_s = 0.0
        if job is not None:
            self._tracker.searched(job, self._localiser.localise_luma(job.luma, job.prior))
            searched_s = time.process_time() - tracked_s
            fix = self._tracker.locate(frame, time_ns)
        self.fixes.append(TimedFix(fix, 1e3 * (tracked_s - begun_s), 1e3 * searched_s))
        return fix.view

    def _listen(self, now_s: float) -> None:
        """Hand over what the sensor has said by now."""
        while self._waiting and (self._waiting[0].known_s <= now_s + 1e-6 or not self._heard):
            self._heard = True
            self._tracker.measure(_measurement(self._waiting.popleft()))


def own_poses(pictures: Sequence[PosedPicture]) -> list[Observation]:
    """Return the pictures' own poses as observations, each at its picture's time."""
    return [
        Observation(time_s, time_s, picture.camera.world_from_cam, OWN_SD_M, OWN_SD_DEG)
        for time_s, picture in zip(times_of(pictures), pictures, strict=True)
    ]


def times_of(pictures: Sequence[PosedPicture]) -> list[float]:
    """Return the pictures' times in seconds, after 1000; at ``ASSUMED_HZ`` where they have none."""
    times_ns = [picture.time_ns for picture in pictures]
    if all(before < after for before, after in pairwise(times_ns)) and len(times_ns) > 1:
        return [1000.0 + (time_ns - times_ns[0]) / NS for time_ns in times_ns]
    return [1000.0 + number / ASSUMED_HZ for number in range(len(pictures))]


def _measurement(seen: Observation) -> PoseMeasurement:
    return PoseMeasurement(
        round(NS * seen.taken_s),
        seen.world_from_cam.translation_m,
        (seen.position_sd_m,) * 3,
        seen.world_from_cam.rotation,
        seen.rotation_sd_deg,
    )
