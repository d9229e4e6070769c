"""Savings at equal quality: what the camera frames cost as I pictures of the same PSNR.

An intra curve holds the mean bytes and mean quality of frames coded as I pictures at several CRFs.
Between its points, log(bytes) is interpolated linearly over the quality in decibels, as rate
curves of video are close to straight there. Outside its points it says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rfcore.codec.config import CodecConfig
from rfcore.codec.h264 import EncoderOptions, H264Decoder, PictureKind, encode_pictures
from rfcore.codec.paper import slice_nals
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.metrics import psnr

__all__ = ["IntraPoint", "intra_curve", "luma_psnr_db", "saving_at_equal_psnr"]

MIN_POINTS = 4
Quality = Callable[[I420, I420], float]


@dataclass(frozen=True)
class IntraPoint:
    """Means over the frames: slice bytes without start codes, and the quality in decibels."""

    crf: float
    mean_bytes: float
    mean_psnr_db: float


def luma_psnr_db(a: I420, b: I420) -> float:
    """Return the PSNR of the luma planes, peak 255; infinite for identical planes."""
    return psnr(a.y, b.y)


def intra_curve(
    frames: Sequence[I420], preset: str, crfs: Sequence[float], quality: Quality = luma_psnr_db
) -> tuple[IntraPoint, ...]:
    """Code each frame as an I picture at each CRF; one point per CRF, best quality first.

    ``quality`` compares (decoded, frame) in decibels and must be the measure the saving is asked
    for. Raises ``InvalidInput`` without frames, or for what ``CodecConfig`` refuses.
    """
    if not frames:
        raise InvalidInput("frames", "an intra curve needs at least one frame")
    return tuple(_point(frames, preset, crf, quality) for crf in sorted(crfs))


def saving_at_equal_psnr(curve: Sequence[IntraPoint], coded_bytes: float, psnr_db: float) -> float:
    """Return 100 (1 - coded_bytes / intra bytes at the same ``psnr_db``), in percent.

    Raises ``InvalidInput`` for fewer than 4 points, a curve that is not strictly rising in both
    bytes and quality, or a quality outside it.
    """
    points = sorted(curve, key=lambda point: point.mean_psnr_db)
    qualities = np.array([point.mean_psnr_db for point in points])
    log_bytes = np.log([point.mean_bytes for point in points])
    if len(points) < MIN_POINTS:
        raise InvalidInput("curve", f"{len(points)} points where {MIN_POINTS} are needed")
    if not (np.isfinite(qualities).all() and (np.diff(qualities) > 0).all()):
        raise InvalidInput("curve", f"qualities {qualities} must be finite and distinct")
    if not (np.diff(log_bytes) > 0).all():
        raise InvalidInput("curve", "bytes must rise with quality; take CRFs further apart")
    if not (coded_bytes > 0 and qualities[0] <= psnr_db <= qualities[-1]):
        raise InvalidInput(
            "psnr_db",
            f"{psnr_db:.2f} dB at {coded_bytes:g} bytes is outside the curve's "
            f"{qualities[0]:.2f}..{qualities[-1]:.2f} dB; code I pictures at more CRFs",
        )
    intra_bytes = math.exp(float(np.interp(psnr_db, qualities, log_bytes)))
    return 100.0 * (1.0 - coded_bytes / intra_bytes)


def _point(frames: Sequence[I420], preset: str, crf: float, quality: Quality) -> IntraPoint:
    config = CodecConfig(*frames[0].size_px, preset=preset, crf=crf)
    options = EncoderOptions(config.coded_size_px, preset, crf, params={"keyint": "1"})
    units = encode_pictures(options, [(frame, PictureKind.I) for frame in frames])
    sizes = [sum(map(len, slice_nals(unit))) for unit in units]
    decoder = H264Decoder(config.coded_size_px)
    qualities = [
        quality(_cropped(decoder.decode(unit), config), frame)
        for unit, frame in zip(units, frames, strict=True)
    ]
    return IntraPoint(crf, float(np.mean(sizes)), float(np.mean(qualities)))


def _cropped(picture: I420, config: CodecConfig) -> I420:
    width_px, height_px = config.size_px
    return I420(picture.y[:height_px, :width_px], picture.u, picture.v)
