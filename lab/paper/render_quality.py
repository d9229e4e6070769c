"""Measures a render against the camera: PSNR, SSIM, FLIP, and the error by spatial frequency.

The published work explains why savings fall as resolution rises by high frequencies that the field
lost. ``residual_bands`` measures that: the luma energy of the residual in octave bands of radial
frequency, over the camera's own in the same band; 0 is a perfect render, 1 one that might as well
be flat there, above 1 one that does harm. Bands are in cycles a pixel, so that they mean the same
at every size. LPIPS is ``rfedge.evaluate.lpips``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.extras import needs
from rfcore.image import Rgb
from rfcore.metrics import psnr
from rfedge.evaluate.ssim import luma_ssim

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
