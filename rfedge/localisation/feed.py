"""Starts of searches from a recorded pose feed, as a vehicle with that feed would have them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cav_agent.pose_feed import (
    FeedPoses,
    FeedProblem,
    FieldPlacement,
    PoseFeed,
    recorded_time_ns,
)
from rfcore.errors import InvalidData, RfedgeError
from rfcore.field import Bounds
from rfcore.localise.localiser import Localised
from rfcore.localise.prior import PosePrior
from rfcore.views import PosedPicture
from rfedge.localisation.searches import SearchOutcome, StartError, pose_difference

__all__ = ["RecordedFeed", "typical_start"]


class RecordedFeed:
    """A feed read from a file, whose times are those of the drive plus an offset.

    ``problems`` counts what was wrong with it.
    """

    def __init__(self, offset_s: float) -> None:
        self.problems: Counter[FeedProblem] = Counter()
        self._poses: FeedPoses
        self._times_ns: list[int]
        self._feed = PoseFeed(self._told, offset_s=offset_s, recorded=True)

    @staticmethod
    def read(path: Path, offset_s: float) -> RecordedFeed:
        """Read a file; raise ``InvalidData`` where it holds no fix at all."""
        read = RecordedFeed(offset_s)
        read._feed.receive(path.read_bytes(), 0)
        read._feed.end(0)
        if not read.fixes:
            found = ", ".join(f"{problem} {times}" for problem, times in read.problems.items())
            raise InvalidData(f"{path}: holds no fix ({found or 'it is empty'})")
        return read

    @property
    def fixes(self) -> int:
        """Number of fixes that are used."""
        return self._feed.count

    def priors(
        self,
        pictures: Sequence[PosedPicture],
        placement: FieldPlacement,
        bounds: Bounds,
        rate_hz: float,
    ) -> list[PosePrior | None]:
        """Return what is known of each picture's pose when it is taken, None before the feed."""
        poses = self._poses = FeedPoses(self._feed, placement, bounds, rate_hz=rate_hz)
        self._times_ns = [
            recorded_time_ns(picture, index, rate_hz) for index, picture in enumerate(pictures)
        ]
        found: list[PosePrior | None] = []
        for time_ns in self._times_ns:
            try:
                found.append(poses.prior(time_ns))
            except RfedgeError:
                found.append(None)
        return found

    def time_offset(self, pictures: Sequence[PosedPicture], done: Sequence[SearchOutcome]) -> str:
        """Return in words how late the feed is, by the poses that were found; after ``priors``."""
        found = {id(one.picture): one.answer for one in done}
        for picture, time_ns in zip(pictures, self._times_ns, strict=True):
            answer = found.get(id(picture))
            if isinstance(answer, Localised):
                self._poses.localised(time_ns, answer.world_from_cam.translation_m)
        offset = self._poses.time_offset()
        if offset is None:
            return "time offset not determined: too few fixes, or no change of velocity"
        return f"add {offset.seconds:.3f} s to its times (one sigma {offset.std_s:.3f} s)"

    def _told(self, problem: FeedProblem, text: str, begins: bool) -> None:  # noqa: ARG002
        self.problems[problem] += 1


def typical_start(
    pictures: Sequence[PosedPicture], priors: Sequence[PosePrior | None]
) -> StartError:
    """Return the median error of the starts against the dataset's poses."""
    errors = [
        pose_difference(picture.camera.world_from_cam, prior.world_from_cam)
        for picture, prior in zip(pictures, priors, strict=True)
        if prior is not None
    ]
    return StartError(*(round(float(value), 3) for value in np.median(errors, axis=0)))
