"""One method against rivals on one clip: BD-rates, savings and processor time, as result rows.

Three questions are answered. Against x264 with the tools that ours has: what does the field buy?
Against the best of all rivals that take no more processor time at both ends: is it worth having?
Against the best of all, whatever it takes: what would be left? Beside the BD-rates stand the
curves they were taken from, and what the field itself costs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.metrics import psnr_of_mse
from rfedge.evaluate.clips import STEADY, Clip, CodedClip
from rfedge.evaluate.compare.rows import (
    BEST,
    BEST_OF_ANY_CPU,
    BreakEvenRow,
    CompareRow,
    CurveRow,
    QualityRow,
)
from rfedge.evaluate.performance import HEADLINE_DB, Performance
from rfedge.evaluate.rate_curve import (
    LPIPS,
    Quality,
    Window,
    bd_rate_interval,
    bd_rate_percent,
)

WINDOWS_DB: tuple[Window, ...] = (HEADLINE_DB, (30.0, 33.0), (30.0, 35.0), (35.0, 38.0))
"""The headline window, then others."""
ANCHORS_AND_BEST = ("x264-lowdelay", "x264-our-tools", BEST, BEST_OF_ANY_CPU)
"""Beginnings of the names of families that are compared over the other windows, too."""
SAVING_AT_DB = (31.0, 33.0, 35.0)
BOOTSTRAP_SEED = 2026
PASSES = (1, 10, 100)
BREAK_EVEN_DB = 33.0


def compare_rows(
    clip: Clip,
    method: Performance,
    families: Mapping[str, Sequence[Performance]],
    windows_db: Sequence[Window] = WINDOWS_DB,
    *,
    interval: bool = True,
) -> list[CompareRow]:
    """Return a row per family of rivals, one against the best of no more processor time at both
    ends, and one against the best of all; windows after the first are for the anchors and the best.

    A family is one codec at several settings; the strongest that takes no more processor time than
    the method stands for it, or its quickest if none is that quick. Windows after the first are
    left out where a curve, or that of resampled frames, does not span them: a good field shows
    30 dB before a bit is sent. Without ``interval``, as for a few frames, figures have none. Raises
    ``InvalidInput`` when a curve does not span the first.
    """
    headline, *wider = windows_db
    rows = _window_rows(clip, method, families, headline, interval=interval)
    everybody = [method, *chain.from_iterable(families.values())]
    for window in wider:
        if all(each.steady.spans(window) for each in everybody):
            with suppress(InvalidInput):  # resampled clips leave the window
                rows += _window_rows(
                    clip, method, families, window, ANCHORS_AND_BEST, interval=interval
                )
    return rows


def _window_rows(
    clip: Clip,
    method: Performance,
    families: Mapping[str, Sequence[Performance]],
    window: Window,
    begins: tuple[str, ...] = ("",),
    *,
    interval: bool,
) -> list[CompareRow]:
    """Return the rows of one window against families whose names begin like one of ``begins``."""
    return [
        _row(clip, method, name, rival, window, interval=interval)
        for name, rival in _chosen(method, families, window).items()
        if name.startswith(begins)
    ]


def _chosen(
    method: Performance, families: Mapping[str, Sequence[Performance]], window: Window
) -> dict[str, Performance]:
    """Return the setting that stands for each family, and the best rivals."""

    def strongest(rivals: Sequence[Performance]) -> Performance:
        return min(rivals, key=lambda rival: rival.steady.mean_log_bytes(window))

    chosen = {name: _representative(method, rivals, window) for name, rivals in families.items()}
    everybody = list(chain.from_iterable(families.values()))
    able = [rival for rival in everybody if _comparable(method, rival)]
    if able:
        chosen[BEST] = strongest(able)
    return {**chosen, BEST_OF_ANY_CPU: strongest(everybody)}


def _representative(
    method: Performance, rivals: Sequence[Performance], window: Window
) -> Performance:
    if not rivals:
        raise InvalidInput("rivals", "a family needs at least one setting")
    able = [rival for rival in rivals if _comparable(method, rival)]
    if not able:
        return min(rivals, key=lambda rival: rival.both_ends_ms)
    return min(able, key=lambda rival: rival.steady.mean_log_bytes(window))


def _comparable(method: Performance, rival: Performance) -> bool:
    return rival.both_ends_ms <= method.both_ends_ms


def _row(
    clip: Clip,
    method: Performance,
    family: str,
    rival: Performance,
    window: Window,
    *,
    interval: bool,
) -> CompareRow:
    ours, theirs = method.steady, rival.steady
    ci95 = None
    if interval:
        rng = np.random.default_rng(BOOTSTRAP_SEED)
        ci95 = bd_rate_interval(rival.clips, method.clips, window, rng, least_share=0.5)
    return CompareRow(
        scene=clip.scene,
        hz=clip.rate_hz,
        method=method.name,
        rival=family,
        rival_setting=rival.name,
        window_db=window,
        bd_rate_percent=bd_rate_percent(theirs, ours, window),
        ci95=ci95,
        points=len(method.clips),
        saving_percent_at_db={
            f"{db:g}": 100 * (1 - ours.bytes_at(db) / theirs.bytes_at(db))
            for db in SAVING_AT_DB
            if ours.spans((db, db)) and theirs.spans((db, db))
        },
        first_frame_bytes=_first_frame_bytes(method, window),
        rival_first_frame_bytes=_first_frame_bytes(rival, window),
        ssim=float(_middle(method, window).ssim.mean()),
        rival_ssim=float(_middle(rival, window).ssim.mean()),
        psnr_deviation_db=_deviation_db(_middle(method, window)),
        rival_psnr_deviation_db=_deviation_db(_middle(rival, window)),
        cpu_ms=method.cpu_ms_per_frame,
        rival_cpu_ms=rival.cpu_ms_per_frame,
        both_ends_ms=_both_ends(method),
        rival_both_ends_ms=_both_ends(rival),
        field_psnr_db=clip.field_psnr_db,
    )


def _both_ends(performance: Performance) -> tuple[float, float, float]:
    if performance.cpu is None:
        return (performance.both_ends_ms,) * 3
    return performance.both_ends_ms, performance.cpu.least_ms, performance.cpu.most_ms


def quality_rows(
    quality: Quality,
    clip: Clip,
    method: Performance,
    families: Mapping[str, Sequence[Performance]],
) -> list[QualityRow]:
    """Return a row per setting over the window of another quality; none where a curve does not
    span it."""
    if not families:
        return []
    window = quality.window_db
    ours = quality.curve(method.clips, STEADY, method.least_points)
    curves = {
        (family, rival.name): quality.curve(rival.clips, STEADY, rival.least_points)
        for family, rivals in families.items()
        for rival in rivals
    }
    drive = (clip.scene, clip.rate_hz, method.name)
    return [
        QualityRow(*drive, *rival, quality.window, bd_rate_percent(theirs, ours, window))
        for rival, theirs in curves.items()
        if ours.spans(window) and theirs.spans(window)
    ]


def _middle(performance: Performance, window: Window) -> CodedClip:
    return performance.nearest(sum(window) / 2)


def _first_frame_bytes(performance: Performance, window: Window) -> int:
    return int(_middle(performance, window).frame_bytes[0])


def _deviation_db(clip: CodedClip) -> float:
    return float(np.std([psnr_of_mse(mse) for mse in clip.luma_mse]))


def curve_rows(
    clip: Clip, methods: Sequence[Performance], families: Mapping[str, Sequence[Performance]]
) -> list[CurveRow]:
    """Return the steady-state curve of every coder, from the lowest quality to the highest."""
    everybody = {"": methods, **families}
    return [_curve(clip, family, who) for family, those in everybody.items() for who in those]


def _curve(clip: Clip, family: str, who: Performance) -> CurveRow:
    coded = sorted(who.clips, key=CodedClip.psnr_db)
    return CurveRow(
        scene=clip.scene,
        hz=clip.rate_hz,
        family=family,
        setting=who.name,
        cpu_ms=who.cpu_ms_per_frame,
        both_ends_ms=who.both_ends_ms,
        point=[at.point for at in coded],
        psnr_db=[at.psnr_db() for at in coded],
        bytes_per_frame=[at.bytes_per_frame() for at in coded],
        ssim=[float(at.ssim[STEADY].mean()) for at in coded],
        lpips=[float(at.values(LPIPS.name)[STEADY].mean()) for at in coded]
        if all(LPIPS.name in at.notes for at in coded)
        else None,
    )


def break_even_row(
    clip: Clip, method: Performance, rival: Performance, field_bytes: int
) -> BreakEvenRow:
    """Return what the field's own bytes leave of the saving after 1, 10 and 100 passes.

    A pass is the whole drive once; its first frame is counted with it. Bytes are those at 33 dB, or
    at the lowest quality above it that both curves have. Negative figures are bytes lost.
    """
    at_db = max(BREAK_EVEN_DB, method.steady.psnr_db[0], rival.steady.psnr_db[0])
    frames = clip.drive_frames - 1
    if frames < 1:
        raise InvalidInput("frames", "a pass needs at least 2 frames")
    ours, theirs = (
        who.steady.bytes_at(at_db) * frames + float(who.nearest(at_db).frame_bytes[0])
        for who in (method, rival)
    )
    saved = theirs - ours
    return BreakEvenRow(
        scene=clip.scene,
        hz=clip.rate_hz,
        method=method.name,
        rival=rival.name,
        at_db=float(at_db),
        frames_per_pass=frames + 1,
        field_bytes=field_bytes,
        saved_bytes_per_pass=saved,
        passes_to_break_even=math.ceil(field_bytes / saved) if saved > 0 else None,
        saving_percent_after={
            str(n): 100 * (1 - (n * ours + field_bytes) / (n * theirs)) for n in PASSES
        },
    )
