"""The field archive ``.rff``: named arrays, a JSON header, and a digest over every byte.

Layout, little-endian::

    0    8   magic "RFFIELD" and a zero byte
    8    4   version, uint32, 1
    12   4   length of the JSON header in bytes, uint32
    16   32  SHA-256 of the JSON header
    48   16  zeros
    64   -   JSON header: {"kind", "metadata", "arrays": [{"name", "dtype", "shape", "offset",
             "sha256"}, ...], "data_bytes"}, then zeros up to a multiple of 64
    ...  -   the arrays, row-major, each followed by zeros up to a multiple of 64; "offset" counts
             from the first one, "data_bytes" is the length of all

Nothing in it is executable. Every size is checked against the size of the file before it is
used, and padding must be zero, so any changed byte is noticed. The SHA-256 of the whole file is
the field's id.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.files import DECODED_BYTES, is_regular, open_at_once

MAGIC = b"RFFIELD\0"
VERSION = 1
PREFIX = struct.Struct("<8sII32s16x")
PREFIX_ZEROS = 16
PREFIX_BYTES = PREFIX.size
ALIGN_BYTES = 64
MAX_HEADER_BYTES = 1 << 20
HEAD_BYTES = PREFIX.size + MAX_HEADER_BYTES
"""``check_length`` needs at most this many bytes of a file."""
MAX_DIMENSIONS = 4
MAX_EMPTY_SIZE = 1 << 40
"""Largest product of an empty array's other sides: numpy refuses shapes beyond 2^63."""
RAISE_LIMIT = "if you trust the file, raise it (--max-field-gb; RFEDGE_MAX_FIELD_GB for rfedge)"
DTYPES = ("<f4", "<f2", "<f8", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8")

Array = NDArray[Any]


@dataclass(frozen=True)
class Archive:
    """The content of a field file: its kind ("splats"), JSON metadata, and arrays by name."""

    kind: str
    metadata: Mapping[str, Any]
    arrays: Mapping[str, Array]

    def __post_init__(self) -> None:
        for name, array in self.arrays.items():
            if array.dtype.str not in DTYPES or array.ndim > MAX_DIMENSIONS:
                raise InvalidInput(
                    f"archive.{name}", f"{array.dtype} {array.shape} is not stored in field files"
                )


def encode_archive(archive: Archive) -> bytes:
    """Return the bytes of a field file; equal content gives equal bytes."""
    blobs = {name: np.ascontiguousarray(a).tobytes() for name, a in archive.arrays.items()}
    header = _header_json(archive, blobs)
    prefix = PREFIX.pack(MAGIC, VERSION, len(header), hashlib.sha256(header).digest())
    return b"".join(map(_padded, (prefix, header, *blobs.values())))


def decode_archive(data: bytes, source: str = "field", *, whole: bool = True) -> Archive:
    """Return the content of a field file.

    Unless it must be ``whole``, ``data`` may be the file's beginning; incomplete arrays are left
    out. The arrays are read-only views of ``data``. Raises ``FieldFormatError``, naming ``source``
    and what is wrong, for anything ``encode_archive`` would not have written.
    """
    try:
        return _decode(memoryview(data), whole)
    except _Damage as damage:
        raise FieldFormatError(f"{source}: {damage}") from damage


def header_end(start: bytes) -> int:
    """Return the offset of the arrays in a field file that begins with ``start``.

    ``start``: its first ``PREFIX_BYTES``. Raises ``FieldFormatError`` for another file.
    """
    try:
        return _aligned(PREFIX.size + _prefix(start)[0])
    except _Damage as damage:
        raise FieldFormatError(f"field: {damage}") from damage


def array_ends(head: bytes) -> Mapping[str, int]:
    """Return the offset at which each array of a field file ends, by its name.

    ``head``: the file up to ``header_end``. Raises ``FieldFormatError`` if it is damaged.
    """
    try:
        raw = _header_bytes(memoryview(head))
        entries, ends, end = _header(raw).get("arrays"), {}, _aligned(PREFIX.size + len(raw))
        for entry in entries if isinstance(entries, list) else []:
            end = ends[_described(entry)[0]] = _end_of(entry, end)
    except _Damage as damage:
        raise FieldFormatError(f"field: {damage}") from damage
    return ends


def check_length(head: bytes, size_bytes: int) -> None:
    """Raise ``FieldFormatError`` unless an archive that begins with ``head`` has this length.

    ``head``: its first ``HEAD_BYTES``, or all of it. What follows the header is not checked.
    """
    try:
        raw = _header_bytes(memoryview(head))
        data_bytes = _header(raw).get("data_bytes")
        if not isinstance(data_bytes, int) or isinstance(data_bytes, bool):
            raise _Damage("header lacks 'data_bytes'")
        whole_bytes = _aligned(PREFIX.size + len(raw)) + data_bytes
        if whole_bytes != size_bytes:
            raise _Damage(f"{size_bytes} bytes, the header says {whole_bytes}")
    except _Damage as damage:
        raise FieldFormatError(str(damage)) from damage


def read_file(path: Path, max_bytes: int = DECODED_BYTES) -> bytes:
    """Return the bytes of a file that may hold a field of ``max_bytes`` of memory.

    An archive without its header is no longer than its field. Raises ``FieldFormatError`` for a
    longer file, or one that is no regular file, before any of it is read, and for one that cannot
    be read.
    """
    try:
        with open_at_once(path) as file:
            if not is_regular(file):
                raise FieldFormatError(f"{path}: is no file, but a pipe, a folder or a device")
            size_bytes = os.fstat(file.fileno()).st_size
            if size_bytes > max_bytes + MAX_HEADER_BYTES:
                raise FieldFormatError(
                    f"{path}: {size_bytes / 1e9:.3g} GB are over the limit of "
                    f"{max_bytes / 1e9:.3g} GB; {RAISE_LIMIT}"
                )
            return file.read(max_bytes + MAX_HEADER_BYTES)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def check_array_bytes(archive: Archive, taken_bytes: int, max_bytes: int) -> None:
    """Raise ``InvalidInput`` if the arrays of an archive take more memory than ``max_bytes``."""
    if taken_bytes > max_bytes:
        raise InvalidInput(
            archive.kind,
            f"takes {taken_bytes / 1e9:.3g} GB of memory, over the limit of "
            f"{max_bytes / 1e9:.3g} GB; {RAISE_LIMIT}",
        )


class _Damage(Exception):
    """A fault of a file; becomes a ``FieldFormatError`` that also names the file."""


def _decode(data: memoryview, whole: bool) -> Archive:
    raw = _header_bytes(data)
    header = _header(raw)
    kind, metadata, entries = (header.get(key) for key in ("kind", "metadata", "arrays"))
    if not isinstance(kind, str) or not isinstance(metadata, dict) or not isinstance(entries, list):
        raise _Damage("header lacks 'kind', 'metadata' or 'arrays'")
    start = _aligned(PREFIX.size + len(raw))
    _check_zeros(data, PREFIX.size + len(raw), start)
    arrays, data_bytes = data[start:], header.get("data_bytes")
    if whole and data_bytes != len(arrays):
        raise _Damage(f"{len(arrays)} bytes of arrays, the header says {data_bytes}")
    return Archive(kind, metadata, _arrays(arrays, entries, whole))


def _header_bytes(data: memoryview) -> memoryview:
    """Return the JSON header after checking everything before it, and its digest."""
    length, digest = _prefix(data)
    if length > len(data) - PREFIX.size:
        raise _Damage(f"header of {length} bytes does not fit the file of {len(data)}")
    _check_zeros(data, PREFIX.size - PREFIX_ZEROS, PREFIX.size)
    raw = data[PREFIX.size : PREFIX.size + length]
    if hashlib.sha256(raw).digest() != digest:
        raise _Damage("header is damaged (sha256 differs)")
    return raw


def _prefix(data: bytes | memoryview) -> tuple[int, bytes]:
    """Return the length and the digest of the JSON header."""
    if len(data) < PREFIX.size:
        raise _Damage(f"{len(data)} bytes are too few for a field file")
    magic, version, length, digest = PREFIX.unpack(data[: PREFIX.size])
    if magic != MAGIC:
        raise _Damage("not a field file (it does not start with RFFIELD)")
    if version != VERSION:
        raise _Damage(f"version {version} of the format, this program reads {VERSION}")
    if length > MAX_HEADER_BYTES:
        raise _Damage(f"header of {length} bytes is over the limit of {MAX_HEADER_BYTES}")
    return length, digest


def _header(raw: memoryview) -> dict[str, Any]:
    try:
        header = json.loads(bytes(raw), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise _Damage(f"header is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise _Damage("header is not a JSON object")
    return header


def _arrays(data: memoryview, entries: list[Any], whole: bool) -> dict[str, Array]:
    arrays: dict[str, Array] = {}
    end = 0
    for entry in entries:
        if not whole and _end_of(entry, end) > len(data):
            return arrays
        name, array, end = _array(data, entry, end)
        if name in arrays:
            raise _Damage(f"array '{name}' is there twice")
        arrays[name] = array
    if end != len(data):
        raise _Damage(f"{len(data) - end} bytes after the last array")
    return arrays


def _end_of(entry: Any, offset: int) -> int:
    """Return where the array that starts at ``offset`` ends, padding included."""
    _, dtype, shape = _described(entry)
    return _aligned(offset + math.prod(shape) * dtype.itemsize)


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is not a number")


def _array(data: memoryview, entry: Any, offset: int) -> tuple[str, Array, int]:
    """Return name, array and end of the array that must start at ``offset``."""
    name, dtype, shape = _described(entry)
    size_bytes = math.prod(shape) * dtype.itemsize
    end = offset + size_bytes
    if entry.get("offset") != offset:
        raise _Damage(f"array '{name}' should start at byte {offset}, not {entry.get('offset')}")
    if _aligned(end) > len(data):
        raise _Damage(f"array '{name}' of {size_bytes} bytes does not fit the file of {len(data)}")
    raw = data[offset:end]
    if hashlib.sha256(raw).hexdigest() != entry.get("sha256"):
        raise _Damage(f"array '{name}' is damaged (sha256 differs)")
    _check_zeros(data, end, _aligned(end))
    return name, np.frombuffer(raw, dtype=dtype).reshape(shape), _aligned(end)


def _described(entry: Any) -> tuple[str, np.dtype[Any], tuple[int, ...]]:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise _Damage("an array has no name")
    name, dtype, shape = entry["name"], entry.get("dtype"), entry.get("shape")
    if dtype not in DTYPES:
        raise _Damage(f"array '{name}' has dtype {dtype!r}, not one of {', '.join(DTYPES)}")
    sizes = shape if isinstance(shape, list) and len(shape) <= MAX_DIMENSIONS else [-1]
    if any(type(size) is not int or size < 0 for size in sizes):
        raise _Damage(f"array '{name}' has shape {str(shape)[:60]}")
    if 0 in sizes and math.prod(filter(None, sizes)) > MAX_EMPTY_SIZE:
        raise _Damage(f"array '{name}' has shape {str(shape)[:60]}, of nothing")
    return name, np.dtype(dtype), tuple(sizes)


def _check_zeros(data: memoryview, start: int, end: int) -> None:
    if len(data) < end or any(data[start:end]):
        raise _Damage(f"bytes {start}..{end} should be zero")


def _header_json(archive: Archive, blobs: Mapping[str, bytes]) -> bytes:
    ends = list(accumulate((_aligned(len(blob)) for blob in blobs.values()), initial=0))
    arrays = [
        {
            "name": name,
            "dtype": array.dtype.str,
            "shape": list(array.shape),
            "offset": offset,
            "sha256": hashlib.sha256(blobs[name]).hexdigest(),
        }
        for (name, array), offset in zip(archive.arrays.items(), ends[:-1], strict=True)
    ]
    header = {
        "kind": archive.kind,
        "metadata": dict(archive.metadata),
        "arrays": arrays,
        "data_bytes": ends[-1],
    }
    return json.dumps(header, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _aligned(size: int) -> int:
    return -(-size // ALIGN_BYTES) * ALIGN_BYTES


def _padded(data: bytes) -> bytes:
    return data + bytes(_aligned(len(data)) - len(data))
