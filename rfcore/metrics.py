"""Distances between pictures, in numpy only.

Pictures are [H, W] or [H, W, 3], both of one shape and dtype: uint8, whose peak is 255, or
floating point with a stated peak. Means run over every pixel and channel.

PSNR is 10 log10(peak^2 / MSE) in dB. SSIM is the structural similarity of Wang, Bovik, Sheikh,
Simoncelli, IEEE TIP 13(4), 2004, eq. 13: 11x11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03.
Beyond its border the picture continues as its mirror image, the border pixel not repeated, which
is what torchmetrics does (Wang's own script leaves a frame of 5 px out instead). Reflection is
repeated as often as a small picture needs, so every picture from one pixel up has a value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

Picture = NDArray[Any]
Mask = NDArray[np.bool_]
UINT8_PEAK = 255.0
INT32_SQUARES = (2**31 - 1) // 255**2
"""Number of squared differences of uint8 of which the sum fits into an int32."""
RADIUS_PX = 5
SIGMA_PX = 1.5
K1, K2 = 0.01, 0.03

F64 = NDArray[np.float64]


def _check_comparable(a: Picture, b: Picture) -> None:
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


def _resolve_peak(picture: Picture, peak: float | None) -> float:
    """Return ``peak``, 255 for uint8 when none is given; float pictures must state theirs."""
    if peak is None:
        if picture.dtype != np.uint8:
            raise InvalidInput("peak", f"must be given for {picture.dtype} pictures, 1.0 perhaps")
        return UINT8_PEAK
    if not (math.isfinite(peak) and peak > 0):
        raise InvalidInput("peak", f"{peak} must be finite and above 0")
    return peak


def mean_squared_error(a: Picture, b: Picture) -> float:
    """Return the mean of (a - b)^2 over every pixel and channel: in float64, exact for uint8."""
    _check_comparable(a, b)
    if a.dtype == np.uint8:
        steps = np.subtract(a, b, dtype=np.int16).reshape(len(a), -1)
        row_type = np.int32 if steps.shape[1] <= INT32_SQUARES else np.int64
        rows = np.einsum("ij,ij->i", steps, steps, dtype=row_type)
        return int(rows.sum(dtype=np.int64)) / steps.size
    difference = a.astype(np.float64) - b.astype(np.float64)
    return float(np.mean(difference * difference))


def psnr(a: Picture, b: Picture, peak: float | None = None, mask: Mask | None = None) -> float:
    """Return the PSNR in dB: infinite for identical pictures, by definition.

    ``peak`` is the largest value a sample can have; 255 for uint8. With ``mask`` bool [H, W] the
    mean runs over its pixels alone. Raises ``InvalidInput`` on pictures that cannot be compared, on
    a float picture without peak and on a mask without pixels.
    """
    if mask is not None:
        _check_comparable(a, b)
        _check_mask(a, mask)
        a, b = a[mask][None], b[mask][None]
    error = mean_squared_error(a, b)
    top = _resolve_peak(a, peak)
    return psnr_of_mse(error, top)


def psnr_of_mse(mse: float, peak: float = UINT8_PEAK) -> float:
    """Return the PSNR in dB of a mean squared error; infinite for 0."""
    return math.inf if mse == 0.0 else 10.0 * math.log10(peak * peak / mse)


def ssim(a: Picture, b: Picture, peak: float | None = None, mask: Mask | None = None) -> float:
    """Return the mean SSIM, 1 for identical pictures, at least -1.

    ``peak`` and ``mask`` as for ``psnr``: pixels outside the mask are taken as equal, and the mean
    runs over its own. Raises ``InvalidInput`` on pictures that cannot be compared.
    """
    _check_comparable(a, b)
    top = _resolve_peak(a, peak)
    x, y = (np.atleast_3d(picture).astype(np.float64, order="C") for picture in (a, b))
    if mask is not None:
        _check_mask(a, mask)
        y = np.where(mask[..., None], y, x)
    planes = [_ssim_of_plane(x[..., c].copy(), y[..., c].copy(), top) for c in range(x.shape[2])]
    return float(np.mean(planes if mask is None else [plane[mask] for plane in planes]))


def _check_mask(picture: Picture, mask: Mask) -> None:
    if mask.shape != picture.shape[:2] or mask.dtype != np.bool_:
        raise InvalidInput("mask", f"{mask.dtype} {mask.shape} of a picture {picture.shape}")
    if not mask.any():
        raise InvalidInput("mask", "leaves no pixel to compare")


def _ssim_of_plane(x: F64, y: F64, peak: float) -> F64:
    """Return the SSIM around each pixel of one channel [H, W]."""
    c1, c2 = (K1 * peak) ** 2, (K2 * peak) ** 2
    mean_x, mean_y = _windowed(x), _windowed(y)
    covariance = _windowed(x * y) - mean_x * mean_y
    # var_x + var_y - 2 cov, from differences: of identical pictures exactly 0, so their SSIM is 1.
    spread = np.maximum(_windowed((x - y) ** 2) - (mean_x - mean_y) ** 2, 0.0)
    luminance = (2 * mean_x * mean_y + c1) / (mean_x * mean_x + mean_y * mean_y + c1)
    structure = 1.0 - spread / (np.maximum(2 * covariance + spread, 0.0) + c2)
    return np.asarray(luminance * structure)


def _windowed(plane: F64) -> F64:
    """Return the Gaussian-weighted mean around every pixel of [H, W]."""
    padded = np.pad(plane, RADIUS_PX, mode="reflect")
    height, width = plane.shape
    rows = _filtered([padded[i : i + height] for i in range(2 * RADIUS_PX + 1)])
    return _filtered([rows[:, i : i + width] for i in range(2 * RADIUS_PX + 1)])


def _filtered(shifted: list[F64]) -> F64:
    """Return the sum of the eleven shifted planes under the Gaussian weights."""
    x = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    weights = np.exp(-(x * x) / (2 * SIGMA_PX**2))
    weights /= weights.sum()
    total, term = weights[0] * shifted[0], np.empty(shifted[0].shape)
    for weight, plane in zip(weights[1:], shifted[1:], strict=True):
        total += np.multiply(plane, weight, out=term)
    return np.asarray(total)
