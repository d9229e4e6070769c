"""Searches of ``rfedge localise``, which measure how well the poses of a drive are found again.

A search starts at the dataset's pose of a picture, displaced by a fixed distance, mostly
horizontally, and turned by a fixed angle, mostly in yaw; or at the pose that a recorded feed
states, as a vehicle with that feed would have it (``RecordedFeed``). A pose that comes back counts
as right within 0.3 % of the picture's median depth and 0.1 degrees of the dataset's, as false
otherwise.
"""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cav_agent.pose_feed import (
    FeedPoses,
    FeedProblem,
    FieldPlacement,
    PoseFeed,
    recorded_time_ns,
)
from rfcore.camera import Pose
from rfcore.errors import InvalidData, InvalidInput, RfedgeError
from rfcore.field import FULL, Bounds, Renderer
from rfcore.files import write_whole
from rfcore.image import Rgb
from rfcore.localise.estimate import PosePrior, moved
from rfcore.localise.localiser import Localised, Localiser, Lost, median_depth
from rfcore.motion import rotation_vector
from rfcore.views import PosedPicture

WITHIN_OF_DEPTH = 0.003
WITHIN_DEG = 0.1
ASIDE = 0.1
"""Vertical share of a displacement, and share of a turn that is not yaw: standard deviation."""
NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class StartError:
    """Distance of a search's start from the dataset's pose; also the prior's deviations."""

    position_m: float
    rotation_deg: float


@dataclass(frozen=True)
class SearchOutcome:
    """One search: its picture and start, the answer, and the errors of the pose if there is one.

    A ``right`` pose is the picture's, to the tolerance of this module. ``cpu_ms`` is processor time
    of this process.
    """

    picture: PosedPicture
    start: Pose
    answer: Localised | Lost
    error_m: float | None
    error_deg: float | None
    right: bool
    milliseconds: float
    cpu_ms: float


@dataclass(frozen=True)
class SearchSummary:
    """The searches of a drive from one start error; errors are those of all poses found."""

    drive: str
    start_m: float
    start_deg: float
    tries: int
    localised_percent: float
    median_m: float | None
    median_deg: float | None
    p95_m: float | None
    false_percent: float
    """Poses that came back and are wrong, of all tries."""
    localise_ms: float
    """Median time of a search, features of the picture included."""
    localise_cpu_ms: float | None
    """The same in processor time, which other work on the machine changes less."""

    @staticmethod
    def of(drive: str, error: StartError, done: Sequence[SearchOutcome]) -> SearchSummary:
        """Return the summary of at least one search."""
        errors_m = [one.error_m for one in done if one.error_m is not None]
        errors_deg = [one.error_deg for one in done if one.error_deg is not None]
        false = sum(one.error_m is not None and not one.right for one in done)
        return SearchSummary(
            drive=drive,
            start_m=error.position_m,
            start_deg=error.rotation_deg,
            tries=len(done),
            localised_percent=100 * sum(one.right for one in done) / len(done),
            median_m=float(np.median(errors_m)) if errors_m else None,
            median_deg=float(np.median(errors_deg)) if errors_deg else None,
            p95_m=float(np.percentile(errors_m, 95)) if errors_m else None,
            false_percent=100 * false / len(done),
            localise_ms=float(np.median([one.milliseconds for one in done])),
            localise_cpu_ms=median_cpu_ms(done),
        )

    def __str__(self) -> str:
        errors = "no pose"
        if self.median_m is not None:
            errors = f"median {self.median_m:.3f} m / {self.median_deg:.3f} deg, "
            errors += f"p95 {self.p95_m:.3f} m"
        return (
            f"{self.drive} from {self.start_m:g} m / {self.start_deg:g} deg: "
            f"{self.localised_percent:.1f} % of {self.tries} localised, {errors}; "
            f"false {self.false_percent:.1f} %; "
            f"{self.localise_ms:.0f} ms, {self.localise_cpu_ms:.0f} ms of a core"
        )


def median_cpu_ms(done: Sequence[SearchOutcome]) -> float | None:
    """Return the median processor time of searches, None of no search."""
    return float(np.median([one.cpu_ms for one in done])) if done else None


def parse_start_error(text: str) -> StartError:
    """Return the start error of text such as ``2m:3deg``; raise ``InvalidInput`` otherwise."""
    number = r"(\d+(?:\.\d+)?)"
    match = re.fullmatch(rf"{number}m:{number}deg", text, re.ASCII)
    if match is None or float(match[1]) <= 0 or float(match[2]) <= 0:
        raise InvalidInput("start_error", f"'{text}' is not METRESm:DEGREESdeg, such as 2m:3deg")
    return StartError(float(match[1]), float(match[2]))


def displaced(pose: Pose, error: StartError, rng: np.random.Generator) -> Pose:
    """Return a pose at exactly the start error from ``pose``, in a random direction."""
    heading = rng.uniform(0.0, 2 * math.pi)
    way = np.array([math.sin(heading), ASIDE * rng.normal(), math.cos(heading)])
    axis = np.array([ASIDE * rng.normal(), rng.choice([-1.0, 1.0]), ASIDE * rng.normal()])
    x, y, z = (error.position_m * way / np.linalg.norm(way)).tolist()
    a, b, c = (math.radians(error.rotation_deg) * axis / np.linalg.norm(axis)).tolist()
    return moved(pose, (x, y, z), (a, b, c))


def searches_from_displaced(
    field: Renderer,
    pictures: Sequence[PosedPicture],
    error: StartError,
    tries: int,
    rng: np.random.Generator,
) -> Iterator[SearchOutcome]:
    """Return ``tries`` searches from displaced poses, over the pictures in turn, as they end.

    Raises ``InvalidInput`` for fewer than one.
    """
    if tries < 1:
        raise InvalidInput("tries", f"{tries} tries: at least 1 is needed")
    taken = [pictures[number % len(pictures)] for number in range(tries)]
    starts = (displaced(picture.camera.world_from_cam, error, rng) for picture in taken)
    priors = (PosePrior(start, error.position_m, error.rotation_deg) for start in starts)
    return searches_from(field, taken, priors)


def searches_from(
    field: Renderer, pictures: Sequence[PosedPicture], priors: Iterable[PosePrior | None]
) -> Iterator[SearchOutcome]:
    """Yield one search for each picture with a prior; without one nothing tells where to search."""
    for picture, prior in zip(pictures, priors, strict=True):
        if prior is not None:
            yield search(field, picture, picture.read(), prior)


def search(field: Renderer, picture: PosedPicture, rgb: Rgb, prior: PosePrior) -> SearchOutcome:
    """Return how a search for ``rgb`` ended; its pose is compared with that of ``picture``."""
    localiser = Localiser(field, picture.camera.intrinsics)
    begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
    answer = localiser.localise(rgb, prior)
    took_ms = (1e3 * (time.perf_counter() - begun_s), 1e3 * (time.process_time() - begun_cpu_s))
    start = prior.world_from_cam
    if isinstance(answer, Lost):
        return SearchOutcome(picture, start, answer, None, None, False, *took_ms)
    error_m, error_deg = pose_difference(picture.camera.world_from_cam, answer.world_from_cam)
    limit_m = WITHIN_OF_DEPTH * median_depth(field.render(picture.camera, FULL))
    right = error_m <= limit_m and error_deg <= WITHIN_DEG
    return SearchOutcome(picture, start, answer, error_m, error_deg, right, *took_ms)


def pose_difference(truth: Pose, found: Pose) -> tuple[float, float]:
    """Return how far apart two poses are, metres and degrees."""
    between = truth.inverse().compose(found)
    turned_deg = math.degrees(math.hypot(*rotation_vector(between.rotation)))
    return math.hypot(*between.translation_m), turned_deg


def write_poses(out: Path, done: Iterable[SearchOutcome]) -> int:
    """Write the poses found, the first of each picture, as TUM lines; return how many.

    Pictures without a pose stand as comments, so that no gap is silent. Time is the picture's; in
    a dataset without times it is the picture's number, as the first line says.
    """
    first: dict[str, SearchOutcome] = {}
    for one in done:
        first.setdefault(one.picture.name, one)
    times_ns = [one.picture.time_ns for one in first.values()]
    timed = all(before < after for before, after in pairwise(times_ns)) and len(times_ns) > 1
    lines = [f"# {'seconds' if timed else 'number of the picture'} tx ty tz qx qy qz qw"]
    found = 0
    for number, one in enumerate(first.values()):
        time_text = f"{one.picture.time_ns / NS_PER_S:.9f}" if timed else str(number)
        if isinstance(one.answer, Lost):
            obstacle = one.answer.obstacle.name.lower().replace("_", " ")
            lines.append(f"# {time_text} lost: {obstacle}")
            continue
        found += 1
        pose = one.answer.world_from_cam
        w, x, y, z = pose.rotation
        numbers = (*pose.translation_m, x, y, z, w)
        lines.append(" ".join([time_text, *(f"{value:.9g}" for value in numbers)]))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, "\n".join(lines) + "\n")
    return found


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
