"""What stands beside the BD-rates of a comparison: the curves, and what the field itself costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfcore.errors import InvalidInput
from rfedge.evaluate.compare import STEADY, Contest, Performance

__all__ = ["PASSES", "break_even_row", "curve_rows"]

PASSES = (1, 10, 100)
BREAK_EVEN_DB = 33.0
PEAK = 255.0
Row = dict[str, Any]


def curve_rows(
    contest: Contest, methods: Sequence[Performance], families: Mapping[str, Sequence[Performance]]
) -> list[Row]:
    """Return the steady-state curve of everybody, from the lowest quality to the highest."""
    everybody = {"": methods, **families}
    return [_curve(contest, family, who) for family, those in everybody.items() for who in those]


def _curve(contest: Contest, family: str, who: Performance) -> Row:
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


def break_even_row(
    contest: Contest, method: Performance, rival: Performance, field_bytes: int
) -> Row:
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
