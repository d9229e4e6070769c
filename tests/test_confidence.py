"""Confidence is opacity on any plane, and nothing where depth breaks or nothing was hit."""

import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rfcore.views import BEND_LIMIT, confidence

SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


def plane_depth_m(height: int, width: int, slope: tuple[float, float]) -> np.ndarray:
    """Depth of a plane: its inverse is affine in the picture."""
    v, u = np.mgrid[0:height, 0:width]
    return (1 / (0.2 + slope[0] * u + slope[1] * v)).astype(np.float32)


@pytest.mark.parametrize("slope", [(0, 0), (0.004, 0), (0, 0.02), (-0.003, 0.01)])
def test_an_opaque_plane_is_trusted_however_oblique(slope):
    """Tolerance: depth is rounded at 2^-24, its second difference adds four such errors."""
    depth = plane_depth_m(20, 30, slope)
    got = confidence(depth, np.ones_like(depth))
    assert got.min() >= 1 - 8 * 2**-24 / BEND_LIMIT


def test_both_sides_of_a_silhouette_are_distrusted_and_no_other_pixel():
    depth = np.full((6, 12), 20, np.float32)
    depth[:, :5] = 5
    got = confidence(depth, np.ones_like(depth))
    assert (got[:, 4:6] == 0).all()
    assert (np.delete(got, (4, 5), axis=1) == 1).all()


def test_a_turned_picture_has_the_turned_confidence():
    depth = np.random.default_rng(0).uniform(4, 5, (7, 9)).astype(np.float32)
    opacity = np.random.default_rng(1).uniform(0, 1, (7, 9)).astype(np.float32)
    np.testing.assert_array_equal(
        confidence(depth.T.copy(), opacity.T.copy()), confidence(depth, opacity).T
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (2, 2), (1, 9)])
def test_a_picture_too_small_to_bend_has_its_opacity(size):
    depth = np.full(size, 7, np.float32)
    opacity = np.full(size, 0.75, np.float32)
    np.testing.assert_array_equal(confidence(depth, opacity), opacity)


def test_where_nothing_was_hit_nothing_is_trusted():
    nothing = np.zeros((4, 5), np.float32)
    assert (confidence(nothing, nothing) == 0).all()


@given(st.data())
def test_confidence_is_never_above_opacity_nor_outside_0_to_1(data):
    size = data.draw(SIZES)
    numbers = st.floats(0, 2.0**120, width=32) | st.just(0.0)
    depth = data.draw(hnp.arrays(np.float32, size, elements=numbers))
    opacity = data.draw(hnp.arrays(np.float32, size, elements=st.floats(-1, 2, width=32)))
    got = confidence(depth, opacity)
    assert got.dtype == np.float32
    assert got.flags.c_contiguous
    assert ((got >= 0) & (got <= np.clip(opacity, 0, 1))).all()


def test_the_bytes_are_pinned():
    """Both ends may steer by it: another value is another protocol."""
    rng = np.random.default_rng(5)
    depth = rng.uniform(4, 6, (33, 47)).astype(np.float32)
    opacity = rng.uniform(0, 1, (33, 47)).astype(np.float32)
    digest = hashlib.sha256(confidence(depth, opacity).tobytes()).hexdigest()
    assert digest == "57113ed7bbf28253e8729b80a9d62c5530857fb0efba27b8bb8f684ba10b1aa1"
