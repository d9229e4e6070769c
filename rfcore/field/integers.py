"""Columns of whole numbers as one bounded, entropy-coded byte stream.

A matrix [N, C] becomes, column by column, its numbers less the column's lowest, split into bytes,
lowest bytes first, as many as the largest needs; all planes together are one raw LZMA2 stream
(Python's ``lzma``: a range coder with adaptive contexts, which numbers of uneven frequency need;
deflate's Huffman codes took 12 % more on the first sample's field). The raw format has
no header: nothing in the stream chooses how much memory it takes.
"""

from __future__ import annotations

import lzma
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

DICTIONARY_BYTES = 1 << 20
FILTERS = (
    {
        "id": lzma.FILTER_LZMA2,
        "preset": 6,
        "dict_size": DICTIONARY_BYTES,
        "lc": 4,
        "lp": 0,
        "pb": 0,
    },
)
"""The high bits of the byte before are the only context that helps; they save 1 %."""

MAX_INFLATION = 1000
"""Decoded bytes for each coded one, beyond which a stream is refused as a bomb."""

LIMIT = 1 << 24
"""Numbers are below this, either sign: float32 holds them exactly."""

Integers = NDArray[np.int32]


class TooAlike(InvalidInput):
    """Numbers so alike that a reader would take their stream for a bomb."""


def encode_columns(values: Integers) -> tuple[dict[str, list[int]], NDArray[np.uint8]]:
    """Return the header of ``values`` int32 [N, C], and their stream.

    The header is {"lowest": [...], "bytes": [...]} with one number a column. Raises
    ``TooAlike`` for values that compress better than a reader accepts.
    """
    lowest = values.min(axis=0) if len(values) else np.zeros(values.shape[1], np.int32)
    highest = values.max(axis=0) if len(values) else lowest
    widths = [max(1, -(-int(span).bit_length() // 8)) for span in highest - lowest]
    planes = b"".join(
        _planes(column, width) for column, width in zip((values - lowest).T, widths, strict=True)
    )
    stream = lzma.compress(planes, lzma.FORMAT_RAW, filters=FILTERS)
    if len(planes) > MAX_INFLATION * len(stream):
        raise TooAlike(
            "field",
            f"its numbers are so alike that they compress over {MAX_INFLATION}-fold, which readers "
            "refuse as a decompression bomb; save it uncompressed (rfedge train --plain, rfedge "
            "field --raw)",
        )
    return {"lowest": lowest.tolist(), "bytes": widths}, np.frombuffer(stream, np.uint8)


def decode_columns(
    header: Mapping[str, Any], stream: NDArray[np.uint8], shape: tuple[int, int]
) -> Integers:
    """Return int32 [N, C] of ``shape``; raise ``InvalidInput`` before anything large is allocated.

    The stream must hold exactly as many bytes as ``header`` and ``shape`` say, and no number of
    2^25 or more.
    """
    return open_columns(header, stream, shape).rows(slice(None))


@dataclass(frozen=True)
class Columns:
    """A decoded stream, from which rows are made on request.

    ``planes`` uint8 [sum of ``widths``, N]: the bytes of the columns, lowest first.
    """

    planes: NDArray[np.uint8]
    lowest: Sequence[int]
    widths: Sequence[int]

    def __len__(self) -> int:
        return int(self.planes.shape[1])

    def rows(self, part: slice) -> Integers:
        """Return int32 [n, C]; raise ``InvalidInput`` for a number of 2^25 or more."""
        planes = self.planes[:, part]
        values = np.empty((len(self.widths), planes.shape[1]), np.int32)
        ends = accumulate(self.widths)
        for column, (low, width, end) in enumerate(
            zip(self.lowest, self.widths, ends, strict=True)
        ):
            values[column] = _column(planes[end - width : end]) + low
        return values.T


def open_columns(
    header: Mapping[str, Any], stream: NDArray[np.uint8], shape: tuple[int, int]
) -> Columns:
    """Return the columns of ``shape`` [N, C], as bytes; raises as ``decode_columns``."""
    count, columns = shape
    lowest = _checked(header["lowest"], columns, -LIMIT, LIMIT)
    widths = _checked(header["bytes"], columns, 1, 4)
    data = _inflated(stream, count * sum(widths))
    planes = np.frombuffer(data, np.uint8).reshape(sum(widths), count)
    return Columns(planes, lowest, widths)


def _column(planes: NDArray[np.uint8]) -> Integers:
    """Return the numbers [N] whose bytes are ``planes`` [W, N], lowest first."""
    if len(planes) == 4 and (planes[3] > 1).any():
        raise InvalidInput("stream", "holds a number of 2^25 or more")
    column = np.zeros(planes.shape[1], np.int32)
    for byte, plane in enumerate(planes):
        column |= plane.astype(np.int32) << np.int32(8 * byte)
    return column


def _planes(column: Integers, width: int) -> bytes:
    return b"".join(((column >> (8 * i)) & 255).astype(np.uint8).tobytes() for i in range(width))


def _checked(numbers: Any, count: int, low: int, high: int) -> Sequence[int]:
    if not isinstance(numbers, list) or len(numbers) != count:
        raise InvalidInput("stream", f"{str(numbers)[:60]} is not a list of {count} numbers")
    if any(type(number) is not int or not low <= number <= high for number in numbers):
        raise InvalidInput("stream", f"{str(numbers)[:60]} are not whole numbers {low}..{high}")
    return list(numbers)


def _inflated(stream: NDArray[np.uint8], size_bytes: int) -> bytes:
    if stream.dtype != np.uint8 or stream.ndim != 1:
        raise InvalidInput("stream", f"{stream.dtype} {stream.shape} is not a row of bytes")
    if size_bytes > MAX_INFLATION * len(stream):
        raise InvalidInput("stream", f"{len(stream)} bytes claim to hold {size_bytes}: a bomb")
    decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
    try:
        data = decoder.decompress(stream.tobytes(), max_length=size_bytes + 1)
    except lzma.LZMAError as error:
        raise InvalidInput("stream", f"cannot be decoded ({error})") from error
    if len(data) != size_bytes or not decoder.eof or decoder.unused_data:
        raise InvalidInput("stream", f"does not hold the {size_bytes} bytes it should")
    return data
