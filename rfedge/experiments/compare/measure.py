"""One method against rivals on one clip: BD-rates, savings and processor time, as result rows.

Two questions are answered. Against x264 of the same preset: what does the field buy? Against the
best of all rivals whose sender takes no more processor time than the method's: is it worth having?

What stands beside the BD-rates of a comparison: the curves, and what the field itself costs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from time import monotonic
from typing import Any

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfedge.experiments.cells import CellKey, CellStore, Rows
from rfedge.experiments.clips import ClipCoder, CodedClip
from rfedge.experiments.rate_curve import (
    RateCurve,
    Window,
    bd_rate_interval,
    bd_rate_percent,
    rate_curve,
)

__all__ = [
    "BEST",
    "MIDDLE_DB",
    "PASSES",
    "WINDOWS_DB",
    "Clip",
    "Performance",
    "break_even_row",
    "compare_rows",
    "curve_rows",
    "perform",
    "seconds_left",
]


WINDOWS_DB: tuple[Window, ...] = ((32.0, 35.0), (30.0, 35.0))
"""The headline window first."""
MIDDLE_DB = sum(WINDOWS_DB[0]) / 2
SAVING_AT_DB = (31.0, 33.0, 35.0)
BEST = "best-comparable"
PROBE_FRAMES = 2
TIMED_FRAMES, TIMED_REPEATS = 12, 3
STEADY = slice(1, None)
"""Every frame but the first, which a stream sends once and a clip of 24 frames counts too much."""
BOOTSTRAP_SEED = 2026


@dataclass(frozen=True)
class Clip:
    """A clip with its rate, its name, the digest of its frames, and the field's own quality."""

    scene: str
    rate_hz: float
    frames: Sequence[I420]
    frames_digest: str
    field_psnr_db: float | None

    def cell_key(self, coder: ClipCoder, point: float) -> CellKey:
        """Name the piece that ``coder`` at ``point`` makes of this clip."""
        return {
            "scene": self.scene,
            "hz": self.rate_hz,
            "frames": self.frames_digest,
            "method": coder.name,
            "point": point,
            "version": coder.version,
        }


@dataclass(frozen=True)
class Performance:
    """A method's clips at all its operating points, and its sender's processor time a frame.

    The time is that near the middle of the headline window: it falls with the rate, and a mean over
    all points would hang on how many of them are outside the window.
    """

    name: str
    clips: tuple[CodedClip, ...]
    cpu_ms_per_frame: float

    @property
    def steady(self) -> RateCurve:
        """The curve without the first frame."""
        return rate_curve(self.clips, STEADY)

    def nearest(self, psnr_db: float) -> CodedClip:
        """Return the clip whose quality is nearest to ``psnr_db``."""
        return min(self.clips, key=lambda clip: abs(_psnr_db(clip.luma_mse.mean()) - psnr_db))


def seconds_left(contest: Clip, coders: Iterable[ClipCoder], store: CellStore) -> float:
    """Estimate what is still to code, from two frames of each coder that has something to do."""
    total_s = 0.0
    for coder in coders:
        left = sum(not store.has(contest.cell_key(coder, p)) for p in coder.points)
        if left:
            began_s = monotonic()
            middle = coder.points[len(coder.points) // 2]
            coder.code(contest.frames[:PROBE_FRAMES], contest.rate_hz, middle)
            total_s += left * (monotonic() - began_s) * len(contest.frames) / PROBE_FRAMES
    return total_s


def perform(
    contest: Clip, coder: ClipCoder, store: CellStore, *, retime: bool = False
) -> Performance:
    """Code the contest's clip at every point of ``coder``, taking from ``store`` what is there.

    ``retime`` takes its processor time anew, and nothing else.
    """
    clips = []
    for point in coder.points:

        def make(point: float = point) -> CodedClip:
            return coder.code(contest.frames, contest.rate_hz, point)

        clips.append(store.clip(contest.cell_key(coder, point), make))
    coded = Performance(coder.name, tuple(clips), float("inf"))
    point = coded.nearest(MIDDLE_DB).point
    key = {**contest.cell_key(coder, point), "timed": TIMED_REPEATS}
    if retime:
        store.forget(key)
    (row,) = store.rows(key, lambda: _timed(contest, coder, point))
    return replace(coded, cpu_ms_per_frame=float(row["cpu_ms_per_frame"]))


def _timed(contest: Clip, coder: ClipCoder, point: float) -> Rows:
    """Return the least of a few runs over the beginning of the clip: others only add to it."""
    frames = contest.frames[:TIMED_FRAMES]
    runs = [coder.code(frames, contest.rate_hz, point) for _ in range(TIMED_REPEATS)]
    return [{"cpu_ms_per_frame": min(run.cpu_ms for run in runs) / len(frames)}]


def compare_rows(
    contest: Clip, method: Performance, families: Mapping[str, Sequence[Performance]]
) -> list[dict[str, Any]]:
    """Return a row per window and family of rivals, and one against the best comparable rival.

    A family is one codec at several settings; the strongest that takes no more processor time than
    the method stands for it, or its quickest if none is that quick. A wider window is left out
    where a curve does not span it: a good field shows 30 dB before a bit is sent. Raises
    ``InvalidInput`` when a curve does not span the headline window.
    """
    rows = []
    everybody = [method, *chain.from_iterable(families.values())]
    headline, *wider = WINDOWS_DB
    for window in (headline, *(w for w in wider if all(p.steady.spans(w) for p in everybody))):
        chosen = {name: _champion(method, rivals, window) for name, rivals in families.items()}
        able = [rival for rival in chosen.values() if _comparable(method, rival)]
        if able:
            chosen[BEST] = min(able, key=lambda rival: rival.steady.mean_log_bytes(window))
        rows += [_row(contest, method, name, rival, window) for name, rival in chosen.items()]
    return rows


def _champion(method: Performance, rivals: Sequence[Performance], window: Window) -> Performance:
    if not rivals:
        raise InvalidInput("rivals", "a family needs at least one setting")
    able = [rival for rival in rivals if _comparable(method, rival)]
    if not able:
        return min(rivals, key=lambda rival: rival.cpu_ms_per_frame)
    return min(able, key=lambda rival: rival.steady.mean_log_bytes(window))


def _comparable(method: Performance, rival: Performance) -> bool:
    return rival.cpu_ms_per_frame <= method.cpu_ms_per_frame


def _row(
    contest: Clip, method: Performance, family: str, rival: Performance, window: Window
) -> dict[str, Any]:
    ours, theirs = method.steady, rival.steady
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    return {
        "scene": contest.scene,
        "hz": contest.rate_hz,
        "method": method.name,
        "rival": family,
        "rival_setting": rival.name,
        "window_db": list(window),
        "bd_rate_percent": bd_rate_percent(theirs, ours, window),
        "ci95": list(bd_rate_interval(rival.clips, method.clips, window, rng)),
        "points": len(method.clips),
        "saving_percent_at_db": {
            f"{db:g}": 100 * (1 - ours.bytes_at(db) / theirs.bytes_at(db))
            for db in SAVING_AT_DB
            if ours.spans((db, db)) and theirs.spans((db, db))
        },
        "first_frame_bytes": _first_frame_bytes(method, window),
        "rival_first_frame_bytes": _first_frame_bytes(rival, window),
        "ssim": float(_middle(method, window).ssim.mean()),
        "rival_ssim": float(_middle(rival, window).ssim.mean()),
        "psnr_deviation_db": _deviation_db(_middle(method, window)),
        "rival_psnr_deviation_db": _deviation_db(_middle(rival, window)),
        "cpu_ms": method.cpu_ms_per_frame,
        "rival_cpu_ms": rival.cpu_ms_per_frame,
        "field_psnr_db": contest.field_psnr_db,
    }


def _middle(performance: Performance, window: Window) -> CodedClip:
    return performance.nearest(sum(window) / 2)


def _first_frame_bytes(performance: Performance, window: Window) -> int:
    return int(_middle(performance, window).frame_bytes[0])


def _deviation_db(clip: CodedClip) -> float:
    return float(np.std([_psnr_db(mse) for mse in clip.luma_mse]))


def _psnr_db(mse: float) -> float:
    return float(10 * np.log10(255.0**2 / mse))


PASSES = (1, 10, 100)
BREAK_EVEN_DB = 33.0
PEAK = 255.0
Row = dict[str, Any]


def curve_rows(
    contest: Clip, methods: Sequence[Performance], families: Mapping[str, Sequence[Performance]]
) -> list[Row]:
    """Return the steady-state curve of everybody, from the lowest quality to the highest."""
    everybody = {"": methods, **families}
    return [_curve(contest, family, who) for family, those in everybody.items() for who in those]


def _curve(contest: Clip, family: str, who: Performance) -> Row:
    clips = sorted(who.clips, key=lambda clip: float(clip.luma_mse[STEADY].mean()), reverse=True)
    return {
        "scene": contest.scene,
        "hz": contest.rate_hz,
        "family": family,
        "setting": who.name,
        "cpu_ms": who.cpu_ms_per_frame,
        "point": [clip.point for clip in clips],
        "psnr_db": [float(10 * np.log10(PEAK**2 / clip.luma_mse[STEADY].mean())) for clip in clips],
        "bytes_per_frame": [float(clip.frame_bytes[STEADY].mean()) for clip in clips],
        "ssim": [float(clip.ssim[STEADY].mean()) for clip in clips],
    }


def break_even_row(contest: Clip, method: Performance, rival: Performance, field_bytes: int) -> Row:
    """Return what the field's own bytes leave of the saving after 1, 10 and 100 passes.

    A pass is the clip once; its first frame is counted with it. Bytes are those at 33 dB, or at the
    lowest quality above it that both curves have. Negative figures are bytes lost.
    """
    at_db = max(BREAK_EVEN_DB, method.steady.psnr_db[0], rival.steady.psnr_db[0])
    frames = len(contest.frames) - 1
    if frames < 1:
        raise InvalidInput("frames", "a pass needs at least 2 frames")
    ours, theirs = (
        who.steady.bytes_at(at_db) * frames + float(who.nearest(at_db).frame_bytes[0])
        for who in (method, rival)
    )
    saved = theirs - ours
    return {
        "scene": contest.scene,
        "hz": contest.rate_hz,
        "method": method.name,
        "rival": rival.name,
        "at_db": float(at_db),
        "frames_per_pass": frames + 1,
        "field_bytes": field_bytes,
        "saved_bytes_per_pass": saved,
        "passes_to_break_even": math.ceil(field_bytes / saved) if saved > 0 else None,
        "saving_percent_after": {
            str(n): 100 * (1 - (n * ours + field_bytes) / (n * theirs)) for n in PASSES
        },
    }
