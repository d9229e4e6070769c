"""The pictures of a drive, found in a field from what a sensor with errors says of their poses.

The loop of whoever codes or measures a drive with ``rfcore.localise.tracker`` in one process, where
no clock runs: a search is run at once and its answer used for the very picture.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rfcore.field import RadianceField
from rfcore.image import I420
from rfcore.localise.fix import Fix
from rfcore.localise.measurement import PoseMeasurement
from rfcore.localise.pose_errors import Observation, PoseErrorModel, observed
from rfcore.localise.track import Effort
from rfcore.localise.tracker import PoseTracker
from rfcore.views import FieldView, PosedPicture

__all__ = ["LocatedDrive", "TimedFix"]

UNTIMED_HZ = 10.0
"""Rate of a drive whose pictures have no times."""
NS = 1e9
ONE_MORE_RENDER = Effort(1)


@dataclass(frozen=True)
class TimedFix:
    """What was found of a picture, and the processor time of this process that it took;
    ``search_cpu_ms`` is 0 where no search was run."""

    fix: Fix
    track_cpu_ms: float
    search_cpu_ms: float


class LocatedDrive:
    """Finds the pictures of a drive, in their order. The feed runs before the first picture: its
    first observation is known then, whatever its latency."""

    def __init__(
        self,
        field: RadianceField,
        pictures: Sequence[PosedPicture],
        errors: PoseErrorModel,
        seed: int,
        *,
        effort: Effort = ONE_MORE_RENDER,
        cpu_clock_s: Callable[[], float] = time.process_time,
    ) -> None:
        times_s = times_of(pictures)
        poses = [picture.camera.world_from_cam for picture in pictures]
        self._waiting = _in_order(observed(times_s, poses, errors, np.random.default_rng(seed)))
        self._times_ns = {p.name: round(NS * t) for p, t in zip(pictures, times_s, strict=True)}
        self.tracker = PoseTracker(field, pictures[0].camera.intrinsics, bounds=field.bounds)
        self._localiser = self.tracker.localiser()
        self._effort, self._cpu_s, self._heard = effort, cpu_clock_s, False
        self.fixes: list[TimedFix] = []

    @classmethod
    def of_observations(
        cls, field: RadianceField, pictures: Sequence[PosedPicture], seen: Sequence[Observation]
    ) -> LocatedDrive:
        """Return a drive whose sensor has observed this, on the clock of ``times_of``."""
        drive = cls(field, pictures, PoseErrorModel(), 0)
        drive._waiting = _in_order(seen)
        return drive

    def locate(self, picture: PosedPicture, frame: I420) -> FieldView | None:
        """Return what the field shows where ``frame`` was taken; ``None`` if that is not known."""
        time_ns = self._times_ns[picture.name]
        self._listen(time_ns / NS)
        begun_s = self._cpu_s()
        fix = self.tracker.locate(frame, time_ns, effort=self._effort)
        tracked_s = self._cpu_s()
        job = self.tracker.search()
        searched_s = 0.0
        if job is not None:
            self.tracker.searched(job, self._localiser.localise_luma(job.luma, job.prior))
            searched_s = self._cpu_s() - tracked_s
            fix = self.tracker.locate(frame, time_ns, effort=self._effort)
        self.fixes.append(TimedFix(fix, 1e3 * (tracked_s - begun_s), 1e3 * searched_s))
        return fix.view

    def _listen(self, now_s: float) -> None:
        """Hand over what the sensor has said by now."""
        while self._waiting and (self._waiting[0].known_s <= now_s + 1e-6 or not self._heard):
            self._heard = True
            self.tracker.measure(_measurement(self._waiting.popleft()))


def times_of(pictures: Sequence[PosedPicture]) -> list[float]:
    """Return the pictures' times in seconds, after 1000; those of 10 Hz where they have none."""
    times_ns = [picture.time_ns for picture in pictures]
    if all(before < after for before, after in pairwise(times_ns)) and len(times_ns) > 1:
        return [1000.0 + (time_ns - times_ns[0]) / NS for time_ns in times_ns]
    return [1000.0 + number / UNTIMED_HZ for number in range(len(pictures))]


def _in_order(seen: Sequence[Observation]) -> deque[Observation]:
    """Return observations as they become known."""
    return deque(sorted(seen, key=lambda observation: observation.known_s))


def _measurement(seen: Observation) -> PoseMeasurement:
    return PoseMeasurement(
        round(NS * seen.taken_s),
        seen.world_from_cam.translation_m,
        (seen.position_sd_m,) * 3,
        seen.world_from_cam.rotation,
        seen.rotation_sd_deg,
    )
