"""What frames cost against a field: bits at equal quality, coded as a vehicle codes them.

The frames of a pass are coded in their order at several rates, with the references and the change
of light that the encoder chooses by itself, and log(rate) is interpolated over luma PSNR.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.field.interface import render_field_view
from rfcore.native.yuv import i420_from_rgb
from rfcore.update.passes import SeenFrame

__all__ = ["TRIAL_CRFS", "Trial", "saved_percent", "try_field"]

TRIAL_CRFS = (22.0, 28.0, 34.0)
HEADER_BYTES = 100
"""Of a packet that carries nothing but its pose, about: no saving is infinite."""
LEAST_ERROR = 0.05
"""Squared levels: better than 61 dB is as good."""
EPOCH = 1
Point = tuple[float, float]
"""Luma PSNR, dB, and bytes a frame."""
Told = Callable[[], None]


@dataclass(frozen=True)
class Trial:
    """What the frames of each pass cost, by the pass's number: ascending in quality."""

    points: Mapping[int, tuple[Point, ...]]


def try_field(
    field: RadianceField, frames: Sequence[SeenFrame], told: Told = lambda: None
) -> Trial:
    """Code ``frames`` against ``field``; raise ``InvalidInput`` if there are none.

    ``told`` is called before each frame is coded, at each rate.
    """
    if not frames:
        raise InvalidInput("trial", "no frames are held back: give more")
    by_pass = groupby(frames, lambda frame: frame.pass_number)
    return Trial({number: _points(field, list(of_pass), told) for number, of_pass in by_pass})


def saved_percent(before: Trial, after: Trial) -> dict[int, float]:
    """Return by how many percent fewer bytes each pass takes after than before; below 0: more."""
    return {
        number: 100 * (1 - math.exp(_log_ratio(before.points[number], after.points[number])))
        for number in before.points
    }


def _points(field: RadianceField, frames: Sequence[SeenFrame], told: Told) -> tuple[Point, ...]:
    views = [render_field_view(field, frame.camera) for frame in frames]
    pictures = [i420_from_rgb(frame.rgb) for frame in frames]
    points = []
    for crf in TRIAL_CRFS:
        encoder = DeltaEncoder(CodecConfig(*pictures[0].size_px, crf=crf))
        state, size_bytes, errors = encoder.start(EPOCH), 0, []
        for picture, view in zip(pictures, views, strict=True):
            told()
            coded = encoder.encode(state, picture, view)
            state = coded.state
            size_bytes += len(coded.packet.payload) + len(coded.packet.light)
            off = picture.y.astype(np.float64) - coded.reconstruction.y
            errors.append(float((off * off).mean()))
        psnr_db = 10 * math.log10(255.0**2 / max(float(np.mean(errors)), LEAST_ERROR))
        points.append((psnr_db, size_bytes / len(frames) + HEADER_BYTES))
    return tuple(sorted(points))


def _log_ratio(before: Sequence[Point], after: Sequence[Point]) -> float:
    """Return log(after / before) in the middle of the qualities that both reach."""
    low = max(before[0][0], after[0][0])
    high = min(before[-1][0], after[-1][0])
    quality_db = (low + high) / 2
    return _log_rate(after, quality_db) - _log_rate(before, quality_db)


def _log_rate(points: Sequence[Point], quality_db: float) -> float:
    """Interpolate log(rate) linearly; what lies beyond the points is as the outermost."""
    qualities_db, rates = zip(*points, strict=True)
    return float(np.interp(quality_db, qualities_db, np.log(rates)))
