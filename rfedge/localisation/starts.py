"""How well the poses of a drive are found again from wrong ones: the loop of ``rfedge localise``.

A start is the dataset's pose of a picture, displaced by a fixed distance, mostly horizontally, and
turned by a fixed angle, mostly in yaw. A pose that comes back counts as localised within 0.3 % of
the picture's median depth and 0.1 degrees of the dataset's, as false otherwise.

A false start is a picture and a place that do not belong together: mirrored, which is a street of
the same kind that is nowhere; turned round by half a turn; elsewhere in the street, twice as far
along it as a pose may be from its prior; noise; and pictures of other places (``strangers``), where
there are any. Any pose that comes back from one is false.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.field import FULL, Renderer
from rfcore.files import write_whole
from rfcore.localise.localiser import Localised, Localiser, Lost, median_depth
from rfcore.localise.prior import PosePrior, moved
from rfcore.motion import rotation_vector
from rfcore.views import PosedPicture
from rfedge.localisation.rows import LocaliseRow
from rfedge.results import make_result, provenance

with needs("localise"):
    import cv2

__all__ = [
    "Attempt",
    "StartError",
    "attempts",
    "displaced",
    "parse_start_error",
    "pose_difference",
    "result_of",
    "row_text",
    "searches_from",
    "summary",
    "write_poses",
]

U8 = NDArray[np.uint8]

WITHIN_OF_DEPTH = 0.003
WITHIN_DEG = 0.1
ASIDE = 0.1
"""Vertical share of a displacement, and share of a turn that is not yaw: standard deviation."""
HALF_TURN = (0.0, math.pi, 0.0)
NS_PER_S = 1_000_000_000
ELSEWHERE = 8.0
"""Standard deviations of the start's position that a false start lies along the street."""
FALSE_KINDS = 4


@dataclass(frozen=True)
class StartError:
    """How far from the dataset's pose a search starts; also the prior's standard deviations."""

    position_m: float
    rotation_deg: float


@dataclass(frozen=True)
class Attempt:
    """One search: its picture, its start, what came back, and the errors of the pose if one did.

    ``right``: a pose came back and is the picture's, to the tolerance of this module.
    ``cpu_ms``: processor time of this process.
    """

    picture: PosedPicture
    false_start: bool
    start: Pose
    answer: Localised | Lost
    error_m: float | None
    error_deg: float | None
    right: bool
    milliseconds: float
    cpu_ms: float


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


def attempts(
    field: Renderer,
    pictures: Sequence[PosedPicture],
    error: StartError,
    counts: tuple[int, int],
    seed: int,
    strangers: Sequence[PosedPicture] = (),
) -> Iterator[Attempt]:
    """Return ``counts`` = (tries, false starts) searches, over the pictures in turn, as they end.

    ``strangers``: pictures of other places, of any size, for every second false start.

    Raises ``InvalidInput`` for fewer than one try or a negative number of false starts.
    """
    tries, false_starts = counts
    if tries < 1 or false_starts < 0:
        raise InvalidInput(
            "tries", f"{tries} tries and {false_starts} false starts: at least 1 and 0"
        )
    return _searches(field, pictures, error, counts, (np.random.default_rng(seed), strangers))


def _searches(
    field: Renderer,
    pictures: Sequence[PosedPicture],
    error: StartError,
    counts: tuple[int, int],
    given: tuple[np.random.Generator, Sequence[PosedPicture]],
) -> Iterator[Attempt]:
    (tries, false_starts), (rng, strangers) = counts, given
    for number in range(tries + false_starts):
        picture = pictures[number % len(pictures)]
        start = displaced(picture.camera.world_from_cam, error, rng)
        rgb, false_start = picture.read(), number >= tries
        nth = number - tries
        if false_start and strangers and nth % 2:
            rgb = _sized(strangers[int(rng.integers(len(strangers)))].read(), rgb.shape)
        elif false_start:
            kind = nth // 2 if strangers else nth
            rgb, start = _false_start(kind % FALSE_KINDS, (rgb, start), error, rng)
        prior = PosePrior(start, error.position_m, error.rotation_deg)
        yield _search(field, picture, rgb, prior, false_start=false_start)


def searches_from(
    field: Renderer, pictures: Sequence[PosedPicture], priors: Iterable[PosePrior | None]
) -> Iterator[Attempt]:
    """Return a search a picture from what a sensor knew of its pose, as they end.

    Pictures without a prior are left out: nothing tells where to search.
    """
    for picture, prior in zip(pictures, priors, strict=True):
        if prior is not None:
            yield _search(field, picture, picture.read(), prior)


def _search(
    field: Renderer,
    picture: PosedPicture,
    rgb: U8,
    prior: PosePrior,
    *,
    false_start: bool = False,
) -> Attempt:
    localiser = Localiser(field, picture.camera.intrinsics)
    begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
    answer = localiser.localise(rgb, prior)
    took_ms = (1e3 * (time.perf_counter() - begun_s), 1e3 * (time.process_time() - begun_cpu_s))
    start = prior.world_from_cam
    if isinstance(answer, Lost):
        return Attempt(picture, false_start, start, answer, None, None, False, *took_ms)
    error_m, error_deg = pose_difference(picture.camera.world_from_cam, answer.world_from_cam)
    limit_m = WITHIN_OF_DEPTH * median_depth(field.render(picture.camera, FULL))
    right = not false_start and error_m <= limit_m and error_deg <= WITHIN_DEG
    return Attempt(picture, false_start, start, answer, error_m, error_deg, right, *took_ms)


def _false_start(
    kind: int, given: tuple[U8, Pose], error: StartError, rng: np.random.Generator
) -> tuple[U8, Pose]:
    """Return a picture and a start that do not belong together: mirrored, turned round, elsewhere,
    noise."""
    rgb, start = given
    if kind == 0:
        return np.ascontiguousarray(rgb[:, ::-1]), start
    if kind == 1:
        return rgb, moved(start, (0.0, 0.0, 0.0), HALF_TURN)
    if kind == 2:
        along_m = ELSEWHERE * error.position_m * rng.choice([-1.0, 1.0])
        return rgb, moved(start, (0.0, 0.0, along_m))
    return rng.integers(0, 256, rgb.shape, np.uint8), start


def _sized(rgb: U8, shape: tuple[int, ...]) -> U8:
    """Return the middle of a picture of the aspect ratio of ``shape``, at its size."""
    (height, width), (rows, columns) = rgb.shape[:2], shape[:2]
    kept = min(height / rows, width / columns)
    down, across = int(rows * kept), int(columns * kept)
    top, left = (height - down) // 2, (width - across) // 2
    middle = rgb[top : top + down, left : left + across]
    sized: U8 = cv2.resize(middle, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8)
    return sized


def pose_difference(truth: Pose, found: Pose) -> tuple[float, float]:
    """Return how far apart two poses are, metres and degrees."""
    between = truth.inverse().compose(found)
    turned_deg = math.degrees(math.hypot(*rotation_vector(between.rotation)))
    return math.hypot(*between.translation_m), turned_deg


def summary(drive: str, error: StartError, done: Sequence[Attempt]) -> LocaliseRow:
    """Return the row of a drive's attempts, of which at least one is no false start."""
    tries = [attempt for attempt in done if not attempt.false_start]
    errors_m = [attempt.error_m for attempt in tries if attempt.error_m is not None]
    errors_deg = [attempt.error_deg for attempt in tries if attempt.error_deg is not None]
    wrong = sum(isinstance(a.answer, Localised) and not a.right for a in done)
    return LocaliseRow(
        drive=drive,
        start_m=error.position_m,
        start_deg=error.rotation_deg,
        tries=len(tries),
        false_starts=len(done) - len(tries),
        localised_percent=100 * sum(attempt.right for attempt in tries) / len(tries),
        median_m=float(np.median(errors_m)) if errors_m else None,
        median_deg=float(np.median(errors_deg)) if errors_deg else None,
        p95_m=float(np.percentile(errors_m, 95)) if errors_m else None,
        false_percent=100 * wrong / len(done),
        localise_ms=float(np.median([attempt.milliseconds for attempt in tries])),
        localise_cpu_ms=_median_cpu_ms(tries),
        false_cpu_ms=_median_cpu_ms([attempt for attempt in done if attempt.false_start]),
    )


def _median_cpu_ms(done: Sequence[Attempt]) -> float | None:
    return float(np.median([attempt.cpu_ms for attempt in done])) if done else None


def result_of(rows: Sequence[LocaliseRow], inputs: Iterable[Path]) -> dict[str, Any]:
    """Return the result of kind ``localise`` that holds ``rows``."""
    return make_result("localise", provenance(inputs), {"rows": rows})


def row_text(row: LocaliseRow) -> str:
    """Return a row as the line that the command prints."""
    errors = "no pose"
    if row.median_m is not None:
        errors = f"median {row.median_m:.3f} m / {row.median_deg:.3f} deg, p95 {row.p95_m:.3f} m"
    return (
        f"{row.drive} from {row.start_m:g} m / {row.start_deg:g} deg: "
        f"{row.localised_percent:.1f} % of {row.tries} localised, {errors}; "
        f"false {row.false_percent:.1f} % with {row.false_starts} false starts; "
        f"{row.localise_ms:.0f} ms, {row.localise_cpu_ms:.0f} ms of a core"
    )


def write_poses(out: Path, done: Iterable[Attempt]) -> int:
    """Write the poses found, the first of each picture, as TUM lines; return how many.

    Pictures without a pose stand as comments, so that no gap is silent. Time is the picture's; in
    a dataset without times it is the picture's number, as the first line says.
    """
    first: dict[str, Attempt] = {}
    for attempt in done:
        if not attempt.false_start:
            first.setdefault(attempt.picture.name, attempt)
    times_ns = [attempt.picture.time_ns for attempt in first.values()]
    timed = all(before < after for before, after in pairwise(times_ns)) and len(times_ns) > 1
    lines = [f"# {'seconds' if timed else 'number of the picture'} tx ty tz qx qy qz qw"]
    found = 0
    for number, attempt in enumerate(first.values()):
        time_text = f"{attempt.picture.time_ns / NS_PER_S:.9f}" if timed else str(number)
        if isinstance(attempt.answer, Lost):
            obstacle = attempt.answer.obstacle.name.lower().replace("_", " ")
            lines.append(f"# {time_text} lost: {obstacle}")
            continue
        found += 1
        pose = attempt.answer.world_from_cam
        w, x, y, z = pose.rotation
        lines.append(
            " ".join([time_text, *(f"{v:.9g}" for v in (*pose.translation_m, x, y, z, w))])
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, "\n".join(lines) + "\n")
    return found
