"""The native digest is hashlib's."""

import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.digest import picture_digest

PIECES = st.lists(st.binary(max_size=700), max_size=4)


def native(first: bytes, pieces: list[bytes]) -> bytes:
    return _native.blake2b_128(first, [np.frombuffer(piece, np.uint8) for piece in pieces])


@given(st.binary(max_size=300), PIECES)
def test_pieces_are_hashed_as_if_they_were_one(first: bytes, pieces: list[bytes]) -> None:
    whole = b"".join([first, *pieces])
    assert native(first, pieces) == hashlib.blake2b(whole, digest_size=16).digest()


@pytest.mark.parametrize("size", [0, 1, 127, 128, 129, 255, 256, 257, 1 << 16])
def test_blocks_end_where_they_end(size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    expected = hashlib.blake2b(data, digest_size=16).digest()
    assert native(data, []) == native(b"", [data]) == native(data[:100], [data[100:]]) == expected


@pytest.mark.parametrize("size_px", [(1, 1), (2, 2), (35, 19), (640, 360)])
def test_a_picture_has_the_digest_of_its_definition(size_px: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    width, height = size_px
    half = ((height + 1) // 2, (width + 1) // 2)
    shapes = ((height, width), half, half)
    picture = I420(*(rng.integers(0, 256, shape, dtype=np.uint8) for shape in shapes))
    assert picture_digest(picture) == picture.digest()
    wide = np.pad(picture.y, ((0, 0), (3, 4)))
    assert picture_digest(I420(wide[:, 3:-4], picture.u, picture.v)) == picture.digest()
