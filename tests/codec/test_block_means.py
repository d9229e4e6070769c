"""Block means of the render: tolerant of rounding by construction."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rfcore.codec.packet import (
    BLOCK_MEANS_TOLERANCE,
    block_mean_difference,
    block_mean_digest,
)
from rfcore.image import I420

side = st.integers(1, 70)


def luma_only(y: np.ndarray) -> I420:
    half = ((y.shape[0] + 1) // 2, (y.shape[1] + 1) // 2)
    return I420(y.astype(np.uint8), np.zeros(half, np.uint8), np.zeros(half, np.uint8))


def oracle(y: np.ndarray) -> bytes:
    height, width = y.shape
    means = []
    for i in range(8):
        for j in range(8):
            top, left = i * height // 8, j * width // 8
            bottom = max((i + 1) * height // 8, top + 1)
            right = max((j + 1) * width // 8, left + 1)
            means.append(int(np.floor(y[top:bottom, left:right].mean() + 0.5)))
    return bytes(means)


@given(side, side, st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_it_is_the_rounded_mean_of_each_cell(height, width, seed):
    y = np.random.default_rng(seed).integers(0, 256, (height, width))
    assert block_mean_digest(luma_only(y)) == oracle(y)


@given(side, side, st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_one_level_per_sample_never_exceeds_the_tolerance(height, width, seed):
    rng = np.random.default_rng(seed)
    y = rng.integers(1, 255, (height, width))
    moved = y + rng.choice([rng.integers(-1, 2, y.shape), np.ones_like(y), -np.ones_like(y)])
    difference = block_mean_difference(
        block_mean_digest(luma_only(y)), block_mean_digest(luma_only(moved))
    )
    assert difference <= BLOCK_MEANS_TOLERANCE


def test_the_difference_is_the_largest_in_either_direction():
    a, b = bytearray(64), bytearray(64)
    a[5], b[60] = 9, 255
    assert block_mean_difference(bytes(a), bytes(b)) == 255
    assert block_mean_difference(bytes(a), bytes(64)) == 9
