"""How good a picture is: PSNR, SSIM, FLIP, and what a render misses at which spatial frequency.

The published work explains why savings fall as resolution rises by high frequencies that the field
lost. ``residual_bands`` measures that: the luma energy of the residual in octave bands of radial
frequency, over the camera's own in the same band; 0 is a perfect render, 1 one that might as well
be flat there, above 1 one that does harm. Bands are in cycles a pixel, so that they mean the same
at every size. LPIPS is not computed: its weights are not ours to ship.

``luma_ssim`` is ``rfcore.metrics.ssim`` in float32 and strip by strip, in a fifth of the time: the
same window, constants and mirrored border. 128 is subtracted from all samples before variances are
taken, which do not depend on it, so that the error stays below 1e-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.image import Rgb
from rfcore.metrics import psnr

__all__ = [
    "BANDS",
    "RenderQuality",
    "colour_ssim",
    "flip",
    "luma_ssim",
    "render_quality",
    "residual_bands",
]


RADIUS_PX, SIGMA_PX = 5, 1.5
C1, C2 = np.float32((0.01 * 255) ** 2), np.float32((0.03 * 255) ** 2)
MIDDLE = np.float32(128)
GAUSSIAN = np.exp(-0.5 * (np.arange(RADIUS_PX + 1) / SIGMA_PX) ** 2)
WEIGHTS = (GAUSSIAN / (2 * GAUSSIAN.sum() - 1)).astype(np.float32)
"""Of the middle sample and of those at each distance from it."""
STRIP_ROWS = 32
"""Measured at a time, so that they stay in the processor's caches."""
F32 = NDArray[np.floating[Any]]


def luma_ssim(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the mean SSIM of two planes [H, W]; raise ``InvalidInput`` on unequal shapes."""
    if a.shape != b.shape or a.ndim != 2 or a.dtype != np.uint8 or b.dtype != np.uint8:
        raise InvalidInput("ssim", f"{a.dtype} {a.shape} and {b.dtype} {b.shape}")
    x, y = (np.pad(p.astype(np.float32) - MIDDLE, RADIUS_PX, mode="reflect") for p in (a, b))
    tops = range(0, len(a), STRIP_ROWS)
    strips = (slice(top, top + STRIP_ROWS + 2 * RADIUS_PX) for top in tops)
    total = math.fsum(_similarity_sum(x[strip], y[strip]) for strip in strips)
    return total / a.size


def _similarity_sum(x: F32, y: F32) -> float:
    """Return the sum of SSIM over two planes less ``MIDDLE``, but for a border of RADIUS_PX."""
    mean_x, mean_y = _windowed(x), _windowed(y)
    covariance = _windowed(x * y) - mean_x * mean_y
    spread = np.maximum(_windowed((x - y) ** 2) - (mean_x - mean_y) ** 2, 0)
    mean_x, mean_y = mean_x + MIDDLE, mean_y + MIDDLE
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    structure = 1 - spread / (np.maximum(2 * covariance + spread, 0) + C2)
    return float(np.sum(luminance * structure, dtype=np.float64))


def _windowed(padded: F32) -> F32:
    """Return the mean under the window around each sample that is RADIUS_PX from the border."""
    return _along_rows(_along_rows(padded).T).T


def _along_rows(padded: F32) -> F32:
    """Filter [H + 2 RADIUS_PX, W] to [H, W], the two samples at one distance together."""
    padded = np.ascontiguousarray(padded)
    height = len(padded) - 2 * RADIUS_PX
    filtered: F32 = WEIGHTS[0] * padded[RADIUS_PX : RADIUS_PX + height]
    for distance in range(1, RADIUS_PX + 1):
        above, below = RADIUS_PX - distance, RADIUS_PX + distance
        pair = padded[above : above + height] + padded[below : below + height]
        pair *= WEIGHTS[distance]
        filtered += pair
    return filtered


BANDS = ((0.0, 1 / 16), (1 / 16, 1 / 8), (1 / 8, 1 / 4), (1 / 4, 0.75))
"""Lowest and highest radial frequency in cycles a pixel; the corner of the plane is at 0.71."""
LUMA = np.array([0.2126, 0.7152, 0.0722])
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class RenderQuality:
    """A render against the camera; ``bands`` one ratio for each of ``BANDS``."""

    psnr_db: float
    ssim: float
    bands: tuple[float, ...]


def render_quality(render: Rgb, camera: Rgb) -> RenderQuality:
    """Measure a render, uint8 RGB [H, W, 3]; raises ``InvalidInput`` for unequal sizes."""
    return RenderQuality(
        psnr(render, camera), colour_ssim(render, camera), residual_bands(render, camera)
    )


def flip(render: Rgb, camera: Rgb) -> float:
    """Return the mean FLIP (Andersson et al. 2020) of two pictures of one size, at its default
    viewing distance; it takes longer than everything else here together."""
    with needs("eval"):
        import flip_evaluator

    pictures = (picture.astype(np.float32) / 255 for picture in (camera, render))
    _, mean, _ = flip_evaluator.evaluate(*pictures, "LDR")
    return float(mean)


def colour_ssim(a: Rgb, b: Rgb) -> float:
    """Return the mean SSIM of the three channels."""
    planes = zip(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0), strict=True)
    return float(np.mean([luma_ssim(*map(np.ascontiguousarray, pair)) for pair in planes]))


def residual_bands(render: Rgb, camera: Rgb) -> tuple[float, ...]:
    """Return the residual's energy over the camera's in each of ``BANDS``.

    Pictures are brought to mean 0 and faded out at the edges by a Hann window. A band in which the
    camera has nothing counts as 0 if the render has nothing there either, else as infinite.
    """
    truth, seen = (picture @ LUMA for picture in (camera, render))
    window = np.hanning(truth.shape[0])[:, None] * np.hanning(truth.shape[1])
    residual, own = (_power(plane, window) for plane in (truth - seen, truth - truth.mean()))
    radius = np.hypot(
        np.fft.fftfreq(truth.shape[0])[:, None], np.fft.rfftfreq(truth.shape[1])[None]
    )
    inside = [(radius >= low) & (radius < high) for low, high in BANDS]
    return tuple(_ratio(float(residual[band].sum()), float(own[band].sum())) for band in inside)


def _power(plane: F64, window: F64) -> F64:
    power: F64 = np.abs(np.fft.rfft2(plane * window)) ** 2
    return power


def _ratio(residual: float, own: float) -> float:
    if own > 0:
        return residual / own
    return 0.0 if residual == 0 else float("inf")
