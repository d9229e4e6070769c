"""Which rungs are measured, and what a rung is worth against the first.

For splats: every detail with three, one and no temporal references at three presets, and from the
full rung one further knob at a time. For hash grids: samples along a ray, and the picture's scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfcore.codec.ladder import Rung
from rfcore.errors import InvalidInput
from rfcore.field import Quality
from rfcore.field.interface import NGP, SPLATS
from rfcore.field.quality import DETAILS

__all__ = ["CRFS", "fronts", "rate_percents", "rungs_for"]

CRFS = (23.0, 28.0, 33.0)
PRESETS = ("medium", "veryfast", "ultrafast")
REFERENCES = (3, 1, 0)
SAMPLES = (None, 32, 8)
Row = Mapping[str, Any]


def rungs_for(kind: str, *, quick: bool) -> list[Rung]:
    """Return the rungs to measure with a field of ``kind``, the full one first."""
    if kind == SPLATS:
        return _splat_rungs(quick)
    if kind == NGP:
        samples = (None, 8) if quick else SAMPLES
        return [
            Rung(Quality(samples_per_ray=n, scale=scale), preset="veryfast")
            for n in samples
            for scale in ((0.5,) if quick else (1.0, 0.5))
        ]
    raise InvalidInput("field.kind", f"{kind!r} has no ladder")


def _splat_rungs(quick: bool) -> list[Rung]:
    details = (1.0, 0.25) if quick else DETAILS
    presets = ("medium", "ultrafast") if quick else PRESETS
    grid = [
        Rung(Quality(detail), references, preset=preset)
        for detail in details
        for references in REFERENCES[:: 2 if quick else 1]
        for preset in presets
    ]
    if quick:
        return grid
    one_knob = [
        Rung(Quality(sh_degree=1)),
        Rung(Quality(sh_degree=0)),
        Rung(Quality(scale=0.5)),
        Rung(references=2),
        Rung(photometric=False),
        Rung(preset="superfast"),
        *(Rung(Quality(detail), n, rough=True) for detail in (1.0, 0.5) for n in (3, 2, 1, 0)),
        *(Rung(references=n, preset="veryfast", rough=True) for n in (3, 2, 1, 0)),
    ]
    low = [
        Rung(Quality(0.5, 1), 1, photometric=False, preset="ultrafast"),
        Rung(Quality(0.25, 0), 1, photometric=False, preset="ultrafast"),
    ]
    return grid + one_knob + low


def rate_percents(curves: Sequence[Sequence[Row]]) -> list[float]:
    """Return for each curve (one rung's rows over CRFs) its bits at equal quality, in percent more
    than the first curve's: the mean over the qualities both reach, log(bits) linear in dB.

    Raises ``InvalidInput`` for curves that share no quality.
    """
    return [_rate_percent(curves[0], curve) for curve in curves]


def _rate_percent(base: Sequence[Row], other: Sequence[Row]) -> float:
    ours, theirs = _curve(base), _curve(other)
    low, high = max(ours[0][0], theirs[0][0]), min(ours[0][-1], theirs[0][-1])
    if not low < high:
        raise InvalidInput(
            "ladder",
            f"{other[0]['rung']} reaches {theirs[0][0]:.1f}..{theirs[0][-1]:.1f} dB, the first "
            f"rung {ours[0][0]:.1f}..{ours[0][-1]:.1f} dB; take CRFs further apart",
        )
    grid = np.linspace(low, high, 33)
    difference = np.interp(grid, *theirs) - np.interp(grid, *ours)
    return float(100 * np.expm1(difference.mean()))


def _curve(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    points = sorted((row["psnr_db"], float(np.log(row["bits_per_frame"]))) for row in rows)
    return [db for db, _ in points], [log_bits for _, log_bits in points]


def fronts(rows: Sequence[Row]) -> list[bool]:
    """Tell of each row whether no other at its CRF takes less of the sender's time without more
    bits at equal quality, or fewer bits without more time."""
    return [not any(_beats(other, row) for other in rows) for row in rows]


def _beats(other: Row, row: Row) -> bool:
    if other["settings"]["crf"] != row["settings"]["crf"]:
        return False
    a = (other["sender_ms"], other["rate_percent"])
    b = (row["sender_ms"], row["rate_percent"])
    return a[0] <= b[0] and a[1] <= b[1] and a != b
