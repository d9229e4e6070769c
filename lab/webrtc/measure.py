"""Figures of what a screen showed, by one definition for all: from the camera to the application.

A picture is known by what it shows. A time stamp says about which one it is, since engines align
time stamps to clocks of their own; the camera's picture that is most like it, among the next ones,
says which. Times are of one machine's clock, taken where the camera hands a picture on and where
the receiving application has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.webrtc.camera import CameraPictures
from rfcore.errors import InvalidData
from rfcore.image import I420

SMALL_PX = (64, 36)
"""Pictures are compared at this size: it tells one from the next, and coding noise vanishes."""
NEAR = 1
"""A time stamp may be off by so many pictures."""
STAMP_WEIGHT = 0.01
"""Cost of a number one off its time stamp, in parts of that of a picture of elsewhere."""
FREEZE_PERIODS, FREEZE_MORE_S = 3.0, 0.15
"""A freeze is a gap of at least three periods of the camera, and of one and 150 ms (W3C
webrtc-stats, ``freezeCount``, whose mean distance of pictures is here the camera's: a sender that
leaves pictures out does not raise its own bound)."""

Luma = NDArray[np.uint8]


class ShownPictures:
    """Collects what a screen shows."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._stamps: list[int] = []
        self._lumas: list[Luma] = []

    def take(self, time_ns: int, stamp: int, luma: Luma) -> None:
        """Add a picture."""
        self._times_ns.append(time_ns)
        self._stamps.append(stamp)
        self._lumas.append(luma)

    def write(self, path: Path) -> None:
        """Write all that were shown: times, time stamps, and each picture's luma."""
        arrays: dict[str, Any] = {f"luma{i}": luma for i, luma in enumerate(self._lumas)}
        arrays["times_ns"] = np.array(self._times_ns, np.int64)
        np.savez(path, stamps=np.array(self._stamps, np.int64), **arrays)


@dataclass(frozen=True)
class Shown:
    """Pictures that a screen showed, in their order: nanoseconds of the epoch, number, luma."""

    times_ns: Sequence[int]
    numbers: Sequence[int]
    lumas: Sequence[Luma]


@dataclass(frozen=True)
class Window:
    """Time over which is measured, in nanoseconds of the epoch, and the camera's rate."""

    begin_ns: int
    end_ns: int
    hz: float

    @property
    def length_s(self) -> float:
        """Its length."""
        return (self.end_ns - self.begin_ns) / 1e9


@dataclass(frozen=True)
class Figures:
    """What was shown: ages from capture to shown, quality against the camera's pictures.

    Ages and quality are None if nothing was shown.
    """

    p50_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    frozen_percent: float
    psnr_db: float | None
    shown_hz: float


def read_pictures(path: Path) -> tuple[list[int], NDArray[np.int64], list[Luma]]:
    """Read what ``ShownPictures`` wrote: times, time stamps [N], pictures."""
    with np.load(path) as held:
        times_ns, stamps = held["times_ns"].tolist(), held["stamps"]
        return times_ns, stamps, [held[f"luma{i}"] for i in range(len(times_ns))]


def numbered(
    lumas: Sequence[Luma], about: NDArray[np.float64], camera: CameraPictures
) -> list[int]:
    """Return the camera's number of each picture shown; numbers ascend.

    ``about``: [N] numbers by time stamps, from an unknown origin; the first picture shown is of the
    camera's first cycle. Raises ``InvalidData`` if fewer than half are like the picture they are
    of rather than like any other.
    """
    if not lumas:
        return []
    unlike = _unlikeness(lumas, camera)
    away = np.median(unlike, 1)
    found = [_path(unlike, about + origin, away.mean()) for origin in range(unlike.shape[1])]
    _, numbers = min(found)
    own = unlike[np.arange(len(lumas)), np.array(numbers) % unlike.shape[1]]
    if np.mean(own < 0.5 * away) < 0.5:
        raise InvalidData("pictures shown are not the camera's of that time")
    return numbers


def _path(
    unlike: NDArray[np.float64], about: NDArray[np.float64], scale: float
) -> tuple[float, list[int]]:
    """Return the ascending numbers near ``about`` whose pictures are most alike, and their cost.

    Distance from the time stamp counts little: it decides between pictures that are the same, as
    on either side of the drive's end.
    """
    offsets = np.arange(-NEAR, NEAR + 1)
    numbers = np.rint(about).astype(int)[:, None] + offsets
    rows = np.arange(len(about))[:, None]
    costs = unlike[rows, numbers % unlike.shape[1]]
    costs = costs + STAMP_WEIGHT * scale * (numbers - about[:, None]) ** 2
    best, back = costs[0], []
    for before, now, cost in zip(numbers, numbers[1:], costs[1:], strict=False):
        reached = np.where(before[None, :] < now[:, None], best[None, :], np.inf)
        back.append(reached.argmin(1))
        best = cost + reached.min(1)
    at = int(best.argmin())
    chosen = [at]
    for each in reversed(back):
        chosen.append(int(each[chosen[-1]]))
    picked = numbers[rows[:, 0], np.array(chosen[::-1])]
    return float(best[at]), picked.tolist()


def _unlikeness(lumas: Sequence[Luma], camera: CameraPictures) -> NDArray[np.float64]:
    """Return [N, length of the camera's cycle]: mean squares of differences of small pictures."""
    cycle = np.stack([_small(camera.at(k).y) for k in range(len(camera.cycle))])
    shown = np.stack([_small(luma) for luma in lumas])
    return np.stack([((cycle - one) ** 2).mean(1) for one in shown])


def _small(luma: Luma) -> NDArray[np.float64]:
    return cv2.resize(luma, SMALL_PX, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()


def figures_of(
    shown: Shown, captured_ns: Mapping[int, int], camera: CameraPictures, window: Window
) -> Figures:
    """Return the figures of a window; ages and quality are of the pictures captured in it.

    Raises ``InvalidData`` for a picture that was shown before it was captured.
    """
    ages_ms, qualities_db = list[float](), list[float]()
    for time_ns, number, luma in zip(shown.times_ns, shown.numbers, shown.lumas, strict=True):
        captured = captured_ns.get(number)
        if captured is None or not window.begin_ns <= captured < window.end_ns:
            continue
        if time_ns < captured:
            raise InvalidData(f"picture {number} was shown before it was captured")
        ages_ms.append((time_ns - captured) / 1e6)
        qualities_db.append(luma_psnr(luma, camera.at(number)))
    in_window = [t for t in shown.times_ns if window.begin_ns <= t < window.end_ns]
    p50, p95, p99 = np.percentile(ages_ms, (50, 95, 99)).tolist() if ages_ms else [None] * 3
    return Figures(
        p50_ms=p50,
        p95_ms=p95,
        p99_ms=p99,
        frozen_percent=frozen_percent(in_window, window),
        psnr_db=float(np.mean(qualities_db)) if ages_ms else None,
        shown_hz=len(in_window) / window.length_s,
    )


def frozen_percent(times_ns: Sequence[int], window: Window) -> float:
    """Return the share of a window that is in gaps between pictures shown that are freezes.

    The window's begin and end count as pictures: a stream that ends early is frozen.
    """
    period_s = 1 / window.hz
    least_s = max(FREEZE_PERIODS * period_s, period_s + FREEZE_MORE_S)
    gaps_s = np.diff([window.begin_ns, *times_ns, window.end_ns]) / 1e9
    return float(100 * gaps_s[gaps_s >= least_s].sum() / window.length_s)


def luma_psnr(luma: Luma, truth: I420) -> float:
    """Return the luma PSNR in dB; a picture that was sent smaller is enlarged, as a screen does."""
    if luma.shape != truth.y.shape:
        luma = cv2.resize(luma, truth.size_px, interpolation=cv2.INTER_CUBIC)  # type: ignore
    error = np.mean((luma.astype(np.float32) - truth.y) ** 2)
    return float(10 * np.log10(255.0**2 / max(float(error), 1e-10)))
