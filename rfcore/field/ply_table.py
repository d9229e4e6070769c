"""The header and the vertex table of a PLY file (G. Turk, "The PLY Polygon File Format", 1994).

Read: any of the three formats, ``element vertex`` first, scalar properties in any order; further
elements are ignored, comments are kept. The row count is checked against the size of the file
before anything is allocated. Rows of text are one a line, with as many numbers as there are
properties; text of nine digits gives back the float32 it was written from.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import FieldFormatError
from rfcore.files import DECODED_BYTES, whole_file

MAX_HEADER_BYTES = 65_536
ASCII = "ascii"
ORDERS = {ASCII: "<", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Byte order of a row, by the name of the format; rows of text are parsed into little-endian."""
SPELLINGS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
DTYPES = {name: code for code, names in SPELLINGS.items() for name in names}


@dataclass(frozen=True)
class Header:
    """The header of a file: the format's name, the number of vertices, the dtype of a row."""

    format: str
    count: int
    dtype: np.dtype[Any]
    comments: tuple[str, ...] = ()
    """The text after ``comment`` of each such line, in the order of the file."""


def read_header(path: Path, file: BinaryIO) -> Header:
    """Read up to and including ``end_header``; the file is left at the first row.

    Raises ``FieldFormatError`` naming the file and the line at fault.
    """
    lines = _lines(path, file)
    words = [line.split() for line in lines[1:-1]]
    comments = tuple(" ".join(line[1:]) for line in words if line[:1] == ["comment"])
    words = [line for line in words if line and line[0] not in ("comment", "obj_info")]
    if not words or words[0][:1] != ["format"] or words[0][1:] not in [[f, "1.0"] for f in ORDERS]:
        found = " ".join(words[0]) if words else "nothing"
        raise FieldFormatError(
            f"{path}: '{found}' where 'format' and one of {', '.join(ORDERS)} 1.0 is needed"
        )
    elements = [i for i, line in enumerate(words) if line[0] == "element"]
    _check_first_element(path, words, elements)
    end = elements[1] if len(elements) > 1 else len(words)
    form = words[0][1]
    count, dtype = _row_count(path, words[1]), _row_dtype(path, words[2:end], ORDERS[form])
    return Header(form, count, dtype, comments)


def _lines(path: Path, file: BinaryIO) -> list[str]:
    lines: list[str] = []
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        lines.append(_printable(line.decode("latin-1").strip()))
        if lines[0] != "ply":
            raise FieldFormatError(f"{path}: does not start with 'ply'")
        if lines[-1] == "end_header":
            return lines
        if not line:
            break
    raise FieldFormatError(f"{path}: no 'end_header' in the first {MAX_HEADER_BYTES} bytes")


def _printable(text: str) -> str:
    """Return text whose control characters, which a terminal might obey, are question marks."""
    return "".join(c if c.isprintable() or c == "\t" else "?" for c in text)


def _check_first_element(path: Path, words: list[list[str]], elements: list[int]) -> None:
    first = words[elements[0]][1:2] if elements else []
    if first == ["chunk"]:
        raise FieldFormatError(
            f"{path}: a compressed .ply of PlayCanvas or SuperSplat; convert it first: "
            "splat-transform IN.compressed.ply OUT.ply"
        )
    if not elements or elements[0] != 1 or first != ["vertex"]:
        raise FieldFormatError(f"{path}: the first element must be 'vertex'")


def _row_count(path: Path, element: list[str]) -> int:
    if len(element) != 3 or not element[2].isascii() or not element[2].isdigit():
        raise FieldFormatError(f"{path}: '{' '.join(element)}' does not state a count")
    return int(element[2][:20])


def _row_dtype(path: Path, properties: list[list[str]], order: str) -> np.dtype[Any]:
    columns: list[tuple[str, str]] = []
    for line in properties:
        if len(line) != 3 or line[0] != "property" or line[1] not in DTYPES:
            raise FieldFormatError(
                f"{path}: '{' '.join(line)}' is not a scalar property (lists are not read)"
            )
        columns.append((line[2], order + DTYPES[line[1]]))
    names = [name for name, _ in columns]
    if not names or len(set(names)) != len(names):
        raise FieldFormatError(f"{path}: vertex properties are missing or repeated")
    return np.dtype(columns)


NAMES = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar"}
ROWS_AT_ONCE = 4096
SHORTEST_VALUE_BYTES = 2
"""A digit and a separator."""
LONGEST_VALUE_BYTES = 64
"""Longest value, on average over a row; a longer line is not read to its end."""
Table = NDArray[np.void]


def read_vertices(path: Path, required: Sequence[str]) -> Table:
    """Return the vertices of a PLY file as a structured array [N].

    Raises ``FieldFormatError``, which names the file and what is wrong with it, when the header
    cannot be read, lacks a ``required`` property, or claims more rows than the file holds or more
    than ``DECODED_BYTES`` of memory.
    """
    try:
        with path.open("rb") as file:
            header = read_vertex_header(path, file, required)
            size_bytes = header.count * header.dtype.itemsize
            if size_bytes > DECODED_BYTES:
                raise FieldFormatError(
                    f"{path}: {header.count} vertices take {size_bytes / 1e9:.2f} GB, the limit "
                    f"is {DECODED_BYTES / 1e9:.2f} GB; write fewer points"
                )
            table = np.empty(header.count, header.dtype)
            for start, rows in read_rows(path, file, header):
                table[start : start + len(rows)] = rows
            return table
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def read_vertex_header(path: Path, file: BinaryIO, required: Sequence[str]) -> Header:
    """Read the header of an open file and check it as ``read_vertices`` does."""
    header = read_header(path, file)
    _check_properties(path, header, required)
    _check_size(path, header, file)
    return header


def read_rows(path: Path, file: BinaryIO, header: Header) -> Iterator[tuple[int, Table]]:
    """Yield (number of the first, rows) for a few thousand rows at a time, until all are read.

    ``file`` stands behind the header. Raises ``FieldFormatError``, ``OSError``.
    """
    for start in range(0, header.count, ROWS_AT_ONCE):
        wanted = min(ROWS_AT_ONCE, header.count - start)
        if header.format == ASCII:
            yield start, _text_rows(path, header, file, start, wanted)
        else:
            yield start, _binary_rows(path, header, file, start, wanted)


def write_vertices(path: Path, table: Table, comments: Sequence[str] = ()) -> None:
    """Write a structured array of little-endian float32 and uint8 columns as PLY, atomically.

    ``comments`` are ASCII text of one line each.
    """
    columns: list[tuple[str, np.dtype[Any]]] = [
        (name, table.dtype[name]) for name in table.dtype.names or ()
    ]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property {NAMES[dtype]} {name}" for name, dtype in columns]
    with whole_file(path) as file:
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        table.tofile(file)


def _check_properties(path: Path, header: Header, required: Sequence[str]) -> None:
    missing = [name for name in required if name not in (header.dtype.names or ())]
    if missing:
        raise FieldFormatError(f"{path}: no vertex property {', '.join(missing)}")


def _check_size(path: Path, header: Header, file: BinaryIO) -> None:
    start = file.tell()
    left_bytes = file.seek(0, os.SEEK_END) - start
    file.seek(start)
    row_bytes = header.dtype.itemsize
    if header.format == ASCII:
        row_bytes = SHORTEST_VALUE_BYTES * len(header.dtype.names or ())
        left_bytes += 1  # the last row need not end with a newline
    if header.count * row_bytes > left_bytes:
        raise FieldFormatError(
            f"{path}: the header claims {header.count * row_bytes} bytes of vertices or more, "
            f"{left_bytes} follow it"
        )


def _binary_rows(path: Path, header: Header, file: BinaryIO, start: int, wanted: int) -> Table:
    data = file.read(wanted * header.dtype.itemsize)
    rows = len(data) // header.dtype.itemsize
    if rows < wanted:
        raise FieldFormatError(f"{path}: {start + rows} rows, the header claims {header.count}")
    return np.frombuffer(data, header.dtype)


def _text_rows(path: Path, header: Header, file: BinaryIO, start: int, wanted: int) -> Table:
    names = header.dtype.names or ()
    limit_bytes = LONGEST_VALUE_BYTES * len(names)
    lines = [line for _ in range(wanted) if (line := file.readline(limit_bytes))]
    values = _numbers(path, lines, start, len(names))
    if len(lines) < wanted:
        raise FieldFormatError(
            f"{path}: {start + len(lines)} rows, the header claims {header.count}"
        )
    table = np.empty(wanted, header.dtype)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            table[name] = values[:, column]
    return table


def _numbers(path: Path, lines: list[bytes], start: int, columns: int) -> NDArray[np.float64]:
    """Return the numbers of text rows [N, C]; raise naming the first row that is not one."""
    rows = [line.split() for line in lines]
    for number, row in enumerate(rows, start):
        if len(row) != columns:
            raise FieldFormatError(f"{path}: row {number} has {len(row)} numbers, not {columns}")
    try:
        return np.array([[float(text) for text in row] for row in rows]).reshape(-1, columns)
    except ValueError as error:
        raise FieldFormatError(f"{path}: row {start} or one after it: {error}") from error
