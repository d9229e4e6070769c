"""Searches that must find nothing: pictures and places that do not belong together.

A false start is a mirrored picture, which shows a street of the same kind that is nowhere; a start
turned by half a turn; a start elsewhere in the street, twice as far along it as a pose may be from
its prior; noise; or a picture of another place, where such pictures (``strangers``) are given. Any
pose that comes back from a false start is false.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.localisation.rows import LocaliseRow
from rfcore.camera import Pose
from rfcore.field import Renderer
from rfcore.localise.estimate import PosePrior, moved
from rfcore.views import PosedPicture
from rfedge.localisation.searches import (
    SearchOutcome,
    SearchSummary,
    StartError,
    displaced,
    median_cpu_ms,
    search,
)

U8 = NDArray[np.uint8]

HALF_TURN = (0.0, math.pi, 0.0)
ELSEWHERE = 8.0
"""Standard deviations of the start's position that a false start lies along the street."""
KINDS = 4


def false_starts(
    field: Renderer,
    pictures: Sequence[PosedPicture],
    error: StartError,
    numbers: range,
    rng: np.random.Generator,
    strangers: Sequence[PosedPicture] = (),
) -> Iterator[SearchOutcome]:
    """Yield one search for each of ``numbers``, which say whose turn it is among ``pictures``.

    ``strangers``: pictures of other places, of any size, for every second false start.
    """
    for nth, number in enumerate(numbers):
        picture = pictures[number % len(pictures)]
        start = displaced(picture.camera.world_from_cam, error, rng)
        rgb = picture.read()
        if strangers and nth % 2:
            rgb = _sized(strangers[int(rng.integers(len(strangers)))].read(), rgb.shape)
        else:
            kind = nth // 2 if strangers else nth
            rgb, start = _mismatched(kind % KINDS, (rgb, start), error, rng)
        prior = PosePrior(start, error.position_m, error.rotation_deg)
        yield replace(search(field, picture, rgb, prior), right=False)


def _mismatched(
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


def row_of(
    drive: str, error: StartError, tries: Sequence[SearchOutcome], false: Sequence[SearchOutcome]
) -> LocaliseRow:
    """Return the row of a drive's tries, of which there is one at least, and its false starts."""
    values = asdict(SearchSummary.of(drive, error, tries))
    done = [*tries, *false]
    wrong = sum(one.error_m is not None and not one.right for one in done)
    return LocaliseRow(
        **{**values, "false_percent": 100 * wrong / len(done)},
        false_starts=len(false),
        false_cpu_ms=median_cpu_ms(false),
    )
