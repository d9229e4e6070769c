"""Block means of a picture: enough of it to tell rounding from a wrong pose.

The luma plane is cut into 8 x 8 blocks; their means, rounded half up, are 64 bytes in reading
order. Block i of a side of n samples covers samples floor(i n / 8) up to
floor((i + 1) n / 8), but at least one.

Tolerance: if no sample differs by more than one level, no mean differs by more than one level,
and neither do the rounded means (x -> floor(x + 1/2) maps numbers at most 1 apart to integers at
most 1 apart). So two renderers that disagree in the last bit always pass at a tolerance of 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.image import I420

_BLOCKS_PER_SIDE = 8
BLOCK_MEANS_BYTES = _BLOCKS_PER_SIDE * _BLOCKS_PER_SIDE
BLOCK_MEANS_TOLERANCE = 1
"""Levels by which a block's mean may differ between renderers that agree up to rounding."""


def block_mean_digest(picture: I420) -> bytes:
    """Return the 64 rounded luma means of ``picture``."""
    height, width = picture.y.shape
    rows, row_counts = _blocks(height)
    columns, column_counts = _blocks(width)
    sums = np.add.reduceat(picture.y, columns, axis=1, dtype=np.int64)
    sums = np.add.reduceat(sums, rows, axis=0)
    counts = row_counts[:, None] * column_counts[None, :]
    means: NDArray[np.int64] = (2 * sums + counts) // (2 * counts)
    return means.astype(np.uint8).tobytes()


def block_mean_difference(a: bytes, b: bytes) -> int:
    """Return the largest difference of the block means of two pictures, in levels."""
    means = (np.frombuffer(digest, np.uint8).astype(np.int16) for digest in (a, b))
    return int(np.abs(np.subtract(*means)).max())


def median_block_mean_difference(a: I420, b: I420) -> float:
    """Return the median of the block means' differences, in levels: how much two lights differ.

    An object that covers less than half of the blocks, as a vehicle does, does not change it.
    """
    means = (np.frombuffer(block_mean_digest(p), np.uint8).astype(np.int16) for p in (a, b))
    return float(np.median(np.abs(np.subtract(*means))))


def _blocks(side: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the first sample and the number of samples of each block."""
    edges = np.arange(_BLOCKS_PER_SIDE + 1) * side // _BLOCKS_PER_SIDE
    return edges[:-1].astype(np.intp), np.maximum(np.diff(edges), 1)
