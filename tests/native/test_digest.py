"""Two digests at a time against hashlib's."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.yuv import digest_pair


def noise(width: int, height: int, seed: int) -> I420:
    rng = np.random.default_rng(seed)
    half = ((height + 1) // 2, (width + 1) // 2)
    return I420(*(rng.integers(0, 256, s, np.uint8) for s in ((height, width), half, half)))


@settings(deadline=None)
@given(st.integers(1, 70), st.integers(1, 40), st.integers(0, 1 << 32))
def test_both_digests_are_the_pictures_own(width, height, seed):
    first, second = noise(width, height, seed), noise(width, height, seed + 1)
    assert digest_pair(first, second) == (first.digest(), second.digest())


def test_planes_may_be_views_of_larger_ones():
    wide = noise(64, 32, 1)
    part = I420(wide.y[:16, :32], wide.u[:8, :16], wide.v[:8, :16])
    assert digest_pair(part, noise(32, 16, 2))[0] == part.digest()


def test_a_changed_sample_changes_its_own_digest_alone():
    first, second = noise(33, 17, 1), noise(33, 17, 2)
    before = digest_pair(first, second)
    second.v[-1, -1] ^= 1
    after = digest_pair(first, second)
    assert after[0] == before[0]
    assert after[1] != before[1]


@pytest.mark.parametrize("count", [1, 127, 128, 129, 255, 256, 257, 1000])
def test_lengths_around_the_blocks_are_hashed_as_hashlib_does(count):
    messages = [np.random.default_rng(seed).integers(0, 256, count, np.uint8) for seed in (1, 2)]
    expected = tuple(hashlib.blake2b(m.tobytes(), digest_size=16).digest() for m in messages)
    assert _native.blake2b_pair(b"", [messages[0]], [messages[1]]) == expected
    split = [[m[: count // 3], m[count // 3 :]] for m in messages]
    assert _native.blake2b_pair(b"", *split) == expected


def test_pictures_of_different_sizes_are_refused():
    with pytest.raises(InvalidInput, match="second"):
        digest_pair(noise(4, 4, 1), noise(4, 2, 1))
    with pytest.raises(ValueError, match="same length"):
        _native.blake2b_pair(b"", [np.zeros(3, np.uint8)], [np.zeros(4, np.uint8)])
