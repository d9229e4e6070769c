"""A codec's performance on a clip, coded at points that span a window of quality, and timed.

Everything is taken from a ``CellStore`` if it is there already.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.metrics import psnr_of_mse
from rfedge.evaluate.clips import STEADY, Clip, ClipCoder, CodedClip
from rfedge.evaluate.rate_curve import MIN_POINTS, RateCurve, Window, rate_curve
from rfedge.evaluate.runner import clip_key, coded_clip
from rfedge.jobs import CellKey, CellStore, Rows

HEADLINE_DB: Window = (32.0, 35.0)
"""Window of luma PSNR that BD-rates are quoted over unless another is asked for."""
LOSSLESS_DB = 99.0
"""Quality at which a frame without any error counts."""
PROBE_FRAMES = 2
TIMED_FRAMES, TIMED_REPEATS, ROUNDS = 12, 3, 5


@runtime_checkable
class BoundedCoder(Protocol):
    """A ``ClipCoder`` that can be asked for other points than its own."""

    @property
    def limits(self) -> tuple[float, float]:
        """The points of the best and of the worst quality that there are."""


@dataclass(frozen=True)
class CpuTime:
    """Processor time a frame: medians over several rounds, and the least and most that both ends
    took together in one. ``receiver_ms`` is None for a method that does not tell."""

    sender_ms: float
    receiver_ms: float | None
    least_ms: float
    most_ms: float

    @property
    def both_ms(self) -> float:
        """Time of both ends, as far as it is known."""
        return self.sender_ms + (self.receiver_ms or 0.0)


@dataclass(frozen=True)
class Performance:
    """A method's clips at all its operating points, and its sender's processor time a frame.

    The time is taken near the middle of the window asked about: it falls with the rate, and a mean
    over all points would depend on how many of them lie outside the window. ``cpu`` says more about
    it if the method took turns with others (``time_in_turns``).
    """

    name: str
    clips: tuple[CodedClip, ...]
    cpu_ms_per_frame: float
    cpu: CpuTime | None = None
    least_points: int = MIN_POINTS

    @property
    def steady(self) -> RateCurve:
        """The curve without the first frame."""
        return rate_curve(self.clips, STEADY, self.least_points)

    @property
    def both_ends_ms(self) -> float:
        """Processor time a frame of both ends where that was taken, else the sender's."""
        return self.cpu_ms_per_frame if self.cpu is None else self.cpu.both_ms

    def nearest(self, psnr_db: float) -> CodedClip:
        """Return the clip whose quality is nearest to ``psnr_db``, its first frame included."""
        every = slice(None)
        return min(self.clips, key=lambda clip: abs(clip.psnr_db(every) - psnr_db))


def seconds_left(clip: Clip, coders: Iterable[ClipCoder], store: CellStore) -> float:
    """Estimate what is still to code, from two frames of each coder that has something to do."""
    total_s = 0.0
    for coder in coders:
        left = sum(not store.has(clip_key(clip, coder, p)) for p in coder.points)
        if left:
            began_s = monotonic()
            middle = coder.points[len(coder.points) // 2]
            coder.code(clip.frames[:PROBE_FRAMES], clip.rate_hz, middle)
            total_s += left * (monotonic() - began_s) * len(clip.frames) / PROBE_FRAMES
    return total_s


def perform(
    clip: Clip,
    coder: ClipCoder,
    store: CellStore,
    *,
    window_db: Window | None = None,
    retime: bool = False,
    timed: bool = True,
) -> Performance:
    """Code ``clip`` at every point of ``coder``, taking from ``store`` what is there.

    With a window, points are added until the curve spans it, as ``spanning_points`` does, and
    processor time is that near its middle. ``retime`` takes it anew, and nothing else; where it is
    not ``timed``, it is not known: infinite.
    """
    points = coder.points
    if window_db is not None:
        points = spanning_points(clip, coder, store, window_db)
    clips = tuple(coded_clip(clip, coder, point, store) for point in points)
    performance = Performance(coder.name, clips, float("inf"))
    if not timed:
        return performance
    point = performance.nearest(sum(window_db or HEADLINE_DB) / 2).point
    key = {**clip_key(clip, coder, point), "timed": TIMED_REPEATS}
    if retime:
        store.cell(key).forget()
    (row,) = store.rows(key, lambda: _timed(clip, coder, point))
    return replace(performance, cpu_ms_per_frame=float(row["cpu_ms_per_frame"]))


def spanning_points(
    clip: Clip, coder: ClipCoder, store: CellStore, window_db: Window
) -> tuple[float, ...]:
    """Return the coder's points, with more beyond either end until they span ``window_db``.

    Codes the clip at the ends alone, so that a window that cannot be spanned is found before the
    rest is coded. Added points are as far apart as the last two, up to the coder's ``limits``.
    Every frame should span the window, so that any resampled clip does; the clip must: raises
    ``WindowNotReached`` with the quality reached otherwise.
    """
    low_db, high_db = window_db
    points = list(coder.points)

    def coded(point: float) -> CodedClip:
        return coded_clip(clip, coder, point, store)

    while _frame_psnr_db(coded(points[0])).min() < high_db:
        better = _beyond(coder, points[1], points[0])
        if better is None:
            break
        points.insert(0, better)
    while _frame_psnr_db(coded(points[-1])).max() > low_db:
        worse = _beyond(coder, points[-2], points[-1])
        if worse is None:
            break
        points.append(worse)
    worst, best = coded(points[-1]), coded(points[0])
    if not worst.psnr_db() <= low_db <= high_db <= best.psnr_db():
        raise WindowNotReached(
            f"{low_db:g}..{high_db:g} dB is not within the {worst.psnr_db():.2f}.."
            f"{best.psnr_db():.2f} dB that {coder.name} reaches on {clip.scene} (points "
            f"{points[0]:g} to {points[-1]:g})",
            _nearest(window_db, worst, best),
        )
    return tuple(points)


class WindowNotReached(InvalidInput):
    """A codec does not reach a window; ``nearest_db`` is a window that all frames reach, if any."""

    def __init__(self, problem: str, nearest_db: Window | None) -> None:
        super().__init__("window", problem)
        self.nearest_db = nearest_db


def _nearest(window_db: Window, worst: CodedClip, best: CodedClip) -> Window | None:
    """Return the nearest window of the same width, or a narrower one, that every frame spans."""
    low_db = math.ceil(10 * min(_frame_psnr_db(worst).max(), LOSSLESS_DB)) / 10
    high_db = math.floor(10 * min(_frame_psnr_db(best).min(), LOSSLESS_DB)) / 10
    width_db = window_db[1] - window_db[0]
    low_db = max(low_db, min(window_db[0], high_db - width_db))
    high_db = min(high_db, round(low_db + width_db, 1))
    return (low_db, high_db) if low_db < high_db else None


def _frame_psnr_db(coded: CodedClip) -> NDArray[np.float64]:
    return np.array([psnr_of_mse(mse) for mse in coded.luma_mse[STEADY]])


def _beyond(coder: ClipCoder, inner: float, end: float) -> float | None:
    """Return the next point after ``end``, one step on from ``inner``; None if there is none."""
    if not isinstance(coder, BoundedCoder) or inner == end:
        return None
    lowest, highest = sorted(coder.limits)
    further = min(max(end + (end - inner), lowest), highest)
    return None if further == end else further


def _timed(clip: Clip, coder: ClipCoder, point: float) -> Rows:
    """Return the least of a few runs over the beginning of the clip: others only add to it."""
    frames = clip.frames[clip.runs[0]][:TIMED_FRAMES]
    runs = [coder.code(frames, clip.rate_hz, point) for _ in range(TIMED_REPEATS)]
    return [{"cpu_ms_per_frame": min(run.cpu_ms for run in runs) / len(frames)}]


def time_in_turns(
    clip: Clip,
    coded: Sequence[tuple[ClipCoder, Performance]],
    store: CellStore,
    window_db: Window,
    *,
    retime: bool = False,
    rounds: int = ROUNDS,
) -> list[Performance]:
    """Return the performances with processor times for which all coders took turns.

    In each round each coder codes and decodes the beginning of the clip once, near the
    middle of the window: what else the machine does falls on all alike.
    """
    middle_db = sum(window_db) / 2
    tasks = {p.name: (coder, p.nearest(middle_db).point) for coder, p in coded}
    key: CellKey = {
        "turns": rounds,
        "frames": clip.frames_digest,
        "hz": clip.rate_hz,
        "coders": "; ".join(f"{n} {c.version} at {p:g}" for n, (c, p) in tasks.items()),
    }
    if retime:
        store.cell(key).forget()
    rows = store.rows(key, lambda: _rounds(clip, tasks, rounds))
    times = {str(row.pop("name")): CpuTime(**row) for row in rows}
    return [
        replace(p, cpu=times[p.name], cpu_ms_per_frame=times[p.name].sender_ms) for _, p in coded
    ]


def _rounds(clip: Clip, tasks: Mapping[str, tuple[ClipCoder, float]], rounds: int) -> Rows:
    frames = clip.frames[clip.runs[0]][:TIMED_FRAMES]
    runs: dict[str, list[CodedClip]] = {name: [] for name in tasks}
    for _ in range(rounds):
        for name, (coder, point) in tasks.items():
            runs[name].append(coder.code(frames, clip.rate_hz, point))
    return [{"name": name} | _cpu_time(those, len(frames)) for name, those in runs.items()]


def _cpu_time(runs: Sequence[CodedClip], frames: int) -> dict[str, float | None]:
    receivers = [run.receiver_cpu_ms for run in runs if run.receiver_cpu_ms is not None]
    both = [run.cpu_ms + (run.receiver_cpu_ms or 0.0) for run in runs]
    return {
        "sender_ms": float(np.median([run.cpu_ms for run in runs])) / frames,
        "receiver_ms": float(np.median(receivers)) / frames if receivers else None,
        "least_ms": min(both) / frames,
        "most_ms": max(both) / frames,
    }
