"""Peak signal-to-noise ratio, 10 log10(peak^2 / MSE) in dB."""

from __future__ import annotations

import math

import numpy as np

from rfcore.metrics.comparison import Picture, check_comparable, resolve_peak

__all__ = ["mean_squared_error", "psnr"]


def mean_squared_error(a: Picture, b: Picture) -> float:
    """Return the mean of (a - b)^2 over every pixel and channel, in float64."""
    check_comparable(a, b)
    difference = a.astype(np.float64) - b.astype(np.float64)
    return float(np.mean(difference * difference))


def psnr(a: Picture, b: Picture, peak: float | None = None) -> float:
    """Return the PSNR in dB: infinite for identical pictures, by definition.

    ``peak`` is the largest value a sample can have; 255 for uint8. Raises ``InvalidInput`` on
    pictures that cannot be compared and on a float picture without peak.
    """
    error = mean_squared_error(a, b)
    top = resolve_peak(a, peak)
    return math.inf if error == 0.0 else 10.0 * math.log10(top * top / error)
