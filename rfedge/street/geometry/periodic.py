"""Looking up values that repeat over the land: fields on cells, sampled between them."""

from __future__ import annotations

import cv2
import numpy as np

from rfedge.street.geometry.mesh import F32

__all__ = ["dithered", "margined", "periodic_at", "shifted"]

BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]], np.float32)


def margined(values: F32) -> F32:
    """Return a periodic [X, Y] with its first row and column once more at the end.

    Wrapping by OpenCV's own border takes four times as long.
    """
    return np.pad(values, (0, 1), mode="wrap")


def periodic_at(values: F32, place: F32) -> F32:
    """Sample a margined [X + 1, Y + 1] bilinearly at places [2, H, W] in periods."""
    turns = place - np.floor(place)
    turns *= np.float32(len(values) - 1)
    return np.asarray(cv2.remap(values, turns[1], turns[0], cv2.INTER_LINEAR), np.float32)


def shifted(values: F32, cells: tuple[float, float]) -> F32:
    """Return a periodic [X, Y] sampled bilinearly so many cells further on."""
    by = np.array(cells, np.float64)
    whole = np.floor(by).astype(int)
    x, y = (by - whole).astype(np.float32)
    near, far = (np.roll(values, (-whole[0], -whole[1] - step), (0, 1)) for step in (0, 1))
    low = near * (1 - y) + far * y
    return np.asarray(low * (1 - x) + np.roll(low, -1, 0) * x, np.float32)


def dithered(shape: tuple[int, int]) -> F32:
    """Return ordered shares -0.5..0.5 [H, W] whose mean over any 4 by 4 neighbours is 0."""
    tiled = np.tile(BAYER, (-(-shape[0] // 4), -(-shape[1] // 4)))
    return np.asarray((tiled[: shape[0], : shape[1]] + 0.5) / 16 - 0.5, np.float32)
