"""Measures the bits of frames coded against a field, to compare fields at equal quality.

The frames of a pass are coded in their order at several CRFs, with the references and the light
that the encoder chooses, as on a vehicle. The logarithm of the rate is interpolated over luma PSNR.
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

TRIAL_CRFS = (22.0, 28.0, 34.0)
HEADER_BYTES = 100
"""Approximate size of a packet with only its pose; without it a saving could be infinite."""
LEAST_ERROR = 0.05
"""Least squared error in levels: a PSNR above 61 dB counts as 61 dB."""
EPOCH = 1
Point = tuple[float, float]
"""Luma PSNR in dB, and bytes a frame."""


@dataclass(frozen=True)
class Trial:
    """Rate and quality of the frames of each pass, by its number, ascending in quality."""

    points: Mapping[int, tuple[Point, ...]]


def try_field(
    field: RadianceField, frames: Sequence[SeenFrame], progress: Callable[[], None] = lambda: None
) -> Trial:
    """Code ``frames`` against ``field``; raise ``InvalidInput`` if there are none.

    ``progress`` is called before each frame is coded, at each CRF.
    """
    if not frames:
        raise InvalidInput("trial", "no frames are held back: give more")
    by_pass = groupby(frames, lambda frame: frame.pass_number)
    return Trial({number: _points(field, list(of_pass), progress) for number, of_pass in by_pass})


def saved_percent(before: Trial, after: Trial) -> dict[int, float]:
    """Return the percentage of bytes that each pass saves; negative if it takes more."""
    return {
        number: 100 * (1 - math.exp(_log_ratio(before.points[number], after.points[number])))
        for number in before.points
    }


def _points(
    field: RadianceField, frames: Sequence[SeenFrame], progress: Callable[[], None]
) -> tuple[Point, ...]:
    views = [render_field_view(field, frame.camera) for frame in frames]
    pictures = [i420_from_rgb(frame.rgb) for frame in frames]
    points = []
    for crf in TRIAL_CRFS:
        encoder = DeltaEncoder(CodecConfig(*pictures[0].size_px, crf=crf))
        state, size_bytes, errors = encoder.start(EPOCH), 0, []
        for picture, view in zip(pictures, views, strict=True):
            progress()
            coded = encoder.encode(state, picture, view)
            state = coded.state
            size_bytes += len(coded.packet.payload) + len(coded.packet.light)
            off = picture.y.astype(np.float64) - coded.reconstruction.y
            errors.append(float((off * off).mean()))
        psnr_db = 10 * math.log10(255.0**2 / max(float(np.mean(errors)), LEAST_ERROR))
        points.append((psnr_db, size_bytes / len(frames) + HEADER_BYTES))
    return tuple(sorted(points))


def _log_ratio(before: Sequence[Point], after: Sequence[Point]) -> float:
    """Return log(after / before) at the middle of the range of quality that both reach."""
    low = max(before[0][0], after[0][0])
    high = min(before[-1][0], after[-1][0])
    quality_db = (low + high) / 2
    return _log_rate(after, quality_db) - _log_rate(before, quality_db)


def _log_rate(points: Sequence[Point], quality_db: float) -> float:
    """Interpolate log(rate) linearly; beyond the points it is constant."""
    qualities_db, rates = zip(*points, strict=True)
    return float(np.interp(quality_db, qualities_db, np.log(rates)))
