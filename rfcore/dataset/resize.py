"""Smaller pictures by area averaging.

Each output pixel is the mean of the rectangle of the input it covers, so that nothing aliases; the
intrinsics that belong to it are ``Intrinsics.resized``, exactly, because pixel centres are at +0.5.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import Rgb

__all__ = ["area_averaged", "check_reduction"]


def check_reduction(name: str, from_px: tuple[int, int], to_px: tuple[int, int]) -> None:
    """Raise ``InvalidInput`` unless ``to_px`` (width, height) is 1 px or more and no larger."""
    if min(to_px) < 1 or to_px[0] > from_px[0] or to_px[1] > from_px[1]:
        raise InvalidInput(
            "size_px",
            f"{to_px[0]}x{to_px[1]} is outside 1x1..{from_px[0]}x{from_px[1]}, the size of {name}",
        )


def area_averaged(rgb: Rgb, width_px: int, height_px: int) -> Rgb:
    """Return uint8 [height, width, 3], rounded half up."""
    means = _averaged(_averaged(rgb.astype(np.float64), height_px, 0), width_px, 1)
    return np.floor(means + 0.5).astype(np.uint8)


def _averaged(values: NDArray[np.float64], count: int, axis: int) -> NDArray[np.float64]:
    """Average along one axis: differences of the running integral at the new pixels' edges."""
    size = values.shape[axis]
    if count == size:
        return values
    zero = np.zeros_like(np.take(values, [0], axis))
    integral = np.concatenate([zero, np.cumsum(values, axis)], axis)
    edges = np.arange(count + 1) * size / count
    before = np.minimum(edges.astype(int), size - 1)
    shape = [1] * values.ndim
    shape[axis] = -1
    share = (edges - before).reshape(shape)
    at_edges = np.take(integral, before, axis) + share * np.take(values, before, axis)
    return np.asarray(np.diff(at_edges, axis=axis) * (count / size))
