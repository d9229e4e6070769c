"""Peak signal-to-noise ratio, 10 log10(peak^2 / MSE) in dB.

What two pictures must share before a number may be put between them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

__all__ = ["Picture", "check_comparable", "mean_squared_error", "psnr", "resolve_peak"]


Picture = NDArray[Any]
UINT8_PEAK = 255.0


def check_comparable(a: Picture, b: Picture) -> None:
    """Raise ``InvalidInput`` unless both are finite pictures of one shape and dtype."""
    if a.shape != b.shape or a.dtype != b.dtype:
        raise InvalidInput(
            "pictures", f"{a.dtype} {a.shape} cannot be compared to {b.dtype} {b.shape}"
        )
    if a.ndim not in (2, 3) or (a.ndim == 3 and a.shape[2] != 3) or 0 in a.shape:
        raise InvalidInput("pictures", f"shape {a.shape} is not [H, W] or [H, W, 3] with a pixel")
    if a.dtype != np.uint8 and not np.issubdtype(a.dtype, np.floating):
        raise InvalidInput("pictures", f"dtype {a.dtype} is neither uint8 nor floating point")
    for name, picture in (("first", a), ("second", b)):
        if not np.isfinite(picture).all():
            raise InvalidInput("pictures", f"the {name} picture has NaN or infinite values")


def resolve_peak(picture: Picture, peak: float | None) -> float:
    """Return ``peak``, 255 for uint8 when none is given; float pictures must state theirs."""
    if peak is None:
        if picture.dtype != np.uint8:
            raise InvalidInput("peak", f"must be given for {picture.dtype} pictures, 1.0 perhaps")
        return UINT8_PEAK
    if not (math.isfinite(peak) and peak > 0):
        raise InvalidInput("peak", f"{peak} must be finite and above 0")
    return peak


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
