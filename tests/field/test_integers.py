"""Columns of whole numbers survive their stream; a stream that lies is refused before it grows."""

import lzma

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rfcore.errors import InvalidInput
from rfcore.field.integers import FILTERS, LIMIT, decode_columns, encode_columns

matrices = hnp.arrays(
    np.int32,
    st.tuples(st.integers(0, 40), st.integers(1, 5)),
    elements=st.integers(-LIMIT + 1, LIMIT - 1),
)


@given(matrices)
def test_numbers_survive_their_stream(values):
    header, stream = encode_columns(values)
    back = decode_columns(header, stream, values.shape)
    assert back.dtype == np.int32
    np.testing.assert_array_equal(back, values)


def test_small_numbers_take_one_byte_each_before_coding():
    header, stream = encode_columns(np.array([[-70_000, 5], [-69_745, 5]], np.int32))
    assert header == {"lowest": [-70_000, 5], "bytes": [1, 1]}
    assert lzma.decompress(stream.tobytes(), lzma.FORMAT_RAW, filters=FILTERS) == b"\0\xff\0\0"


def stream_of(data: bytes) -> np.ndarray:
    return np.frombuffer(lzma.compress(data, lzma.FORMAT_RAW, filters=FILTERS), np.uint8)


@pytest.mark.parametrize(
    ("change", "shape", "named"),
    [
        ({"lowest": [0]}, (6, 2), r"\[0\] is not a list of 2 numbers"),
        ({"lowest": [0, 0.5]}, (6, 2), "not whole numbers"),
        ({"lowest": [0, True]}, (6, 2), "not whole numbers"),
        ({"lowest": [0, LIMIT + 1]}, (6, 2), "not whole numbers"),
        ({"lowest": None}, (6, 2), "None is not a list"),
        ({"bytes": [0, 1]}, (6, 2), r"not whole numbers 1\.\.4"),
        ({"bytes": [5, 1]}, (6, 2), r"not whole numbers 1\.\.4"),
        ({"bytes": [2, 1]}, (6, 2), "does not hold the 18 bytes"),
        ({}, (5, 2), "does not hold the 10 bytes"),
        ({}, (7, 2), "does not hold the 14 bytes"),
        ({}, (50_000_000, 2), "claim to hold 100000000: a bomb"),
    ],
)
def test_a_header_that_lies_is_refused(change, shape, named):
    header, stream = encode_columns(np.arange(12, dtype=np.int32).reshape(6, 2))
    with pytest.raises(InvalidInput, match=named):
        decode_columns({**header, **change}, stream, shape)


@given(st.data())
def test_a_damaged_stream_gives_numbers_of_the_shape_or_is_refused(data):
    """The stream has no checksum of its own, the archive has; nothing else may happen."""
    values = np.random.default_rng(0).integers(0, 300, (40, 3), dtype=np.int32)
    header, stream = encode_columns(values)
    damaged = stream.copy()
    position = data.draw(st.integers(0, len(damaged) - 1))
    damaged[position] ^= data.draw(st.integers(1, 255))
    length = data.draw(st.sampled_from([len(damaged), len(damaged) - 1, len(damaged) // 2]))
    try:
        back = decode_columns(header, damaged[:length], values.shape)
    except InvalidInput:
        return
    assert back.shape == values.shape


@pytest.mark.parametrize("extra", [b"\0", b"more"])
def test_bytes_after_the_stream_are_refused(extra):
    header, stream = encode_columns(np.zeros((4, 1), np.int32))
    longer = np.frombuffer(stream.tobytes() + extra, np.uint8)
    with pytest.raises(InvalidInput, match="does not hold"):
        decode_columns(header, longer, (4, 1))


def test_a_bomb_is_refused_without_inflating_it():
    bomb = stream_of(bytes(10_000_000))
    header = {"lowest": [0], "bytes": [1]}
    with pytest.raises(InvalidInput, match="a bomb"):
        decode_columns(header, bomb, (10_000_000, 1))
    with pytest.raises(InvalidInput, match="does not hold the 100 bytes"):
        decode_columns(header, bomb, (100, 1))


def test_what_a_reader_would_take_for_a_bomb_is_not_written():
    with pytest.raises(InvalidInput, match="save it uncompressed"):
        encode_columns(np.zeros((5_000_000, 1), np.int32))


def test_a_number_beyond_float32s_exact_range_is_refused():
    header = {"lowest": [0], "bytes": [4]}
    with pytest.raises(InvalidInput, match="2\\^25 or more"):
        decode_columns(header, stream_of(b"\0\0\0\2"), (1, 1))


@pytest.mark.parametrize("stream", [np.zeros((2, 2), np.uint8), np.zeros(4, np.float32)])
def test_a_stream_is_a_row_of_bytes(stream):
    with pytest.raises(InvalidInput, match="not a row of bytes"):
        decode_columns({"lowest": [0], "bytes": [1]}, stream, (4, 1))
