"""How much each splat matters, and the order of importance in which archives store them.

With cameras: what a splat contributes, the sum over their pixels of transmittance times alpha.
It is exactly the derivative of the picture's sum with respect to the splat's colour, so the
trainer's backward pass counts it. Without cameras: opacity times the area it could cover, seen
from the middle of the field; a guess, for fields that come without any.

Measured on the first sample (150k splats, 27.1 dB), half / a quarter / a tenth of the splats, with
no compensation: contributions 24.2 / 18.5 / 13.5 dB, the guess 23.2 / 16.9 / 11.8 dB, opacity times
area alone 18.8 / 11.0 / 7.4 dB, random 17.7 / 12.6 / 9.4 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.trainable import TrainableRasterizer

__all__ = ["contributions", "most_important_first", "reordered", "visible_area"]

SH_DC = 0.28209479177387814
"""The constant real spherical harmonic, sqrt(1 / (4 pi))."""
F64 = NDArray[np.float64]


def contributions(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    threads: int = 1,
    antialiased: bool = False,
) -> F64:
    """Return, for each splat [N], its blending weight summed over all pixels of ``cameras``.

    Raises ``InvalidInput`` when there is no camera.
    """
    if not cameras:
        raise InvalidInput("cameras", "at least one is needed to see what splats contribute")
    grey = replace(gaussians, sh=np.zeros((len(gaussians), 1, 3), np.float32))
    rasterizer = TrainableRasterizer(grey, threads=threads, antialiased=antialiased)
    total = np.zeros(len(gaussians))
    for camera in cameras:
        red_of_all = np.zeros_like(rasterizer.forward(camera).colour)
        red_of_all[..., 0] = 1
        rasterizer.backward(red_of_all)
        total += rasterizer.gradients()["sh"][:, 0, 0].astype(np.float64) / SH_DC
    return total


def visible_area(gaussians: Gaussians) -> F64:
    """Return, for each splat [N], opacity times area over squared distance from the middle."""
    if not len(gaussians):
        return np.zeros(0)
    opacity = 1 / (1 + np.exp(-np.clip(gaussians.opacity_logits.astype(np.float64), -60, 60)))
    widest = np.sort(gaussians.log_scales.astype(np.float64), axis=1)[:, 1:]
    means = gaussians.means.astype(np.float64)
    squared = ((means - np.median(means, axis=0)) ** 2).sum(axis=1)
    near = max(float(np.quantile(squared, 0.05)), np.finfo(np.float64).tiny)
    log_area = np.clip(widest.sum(axis=1), -300, 300)
    return np.asarray(opacity * np.exp(log_area) / (squared + near))


def most_important_first(importance: F64) -> NDArray[np.intp]:
    """Return the order [N] of falling importance; equal ones stay in their order."""
    return np.argsort(-importance, kind="stable")


def reordered(gaussians: Gaussians, order: NDArray[np.intp]) -> Gaussians:
    """Return the Gaussians of ``order`` [K], which may leave some out."""
    arrays = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
    return Gaussians(**{name: np.ascontiguousarray(a[order]) for name, a in arrays.items()})
