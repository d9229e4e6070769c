"""The vertex table of a PLY file, by property name; its header is ``rfcore.field.ply_header``.

The row count is checked against the size of the file before anything is allocated. Rows of text
are one a line, with as many numbers as there are properties; text of nine digits gives back the
float32 it was written from.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import FieldFormatError
from rfcore.field.ply_header import ASCII, Header, read_header
from rfcore.files import whole_file

__all__ = ["Table", "read_vertices", "write_vertices"]

NAMES = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar"}
ROWS_AT_ONCE = 4096
SHORTEST_VALUE_BYTES = 2
"""A digit and what separates it from the next."""
LONGEST_VALUE_BYTES = 64
"""On average over a row; a longer line is no row, and is not read to its end."""

Table = NDArray[np.void]


def read_vertices(path: Path, required: Sequence[str]) -> Table:
    """Return the vertices of a PLY file as a structured array [N].

    Raises ``FieldFormatError``, which names the file and what is wrong with it, when the header
    cannot be read, lacks a ``required`` property, or claims more rows than the file holds.
    """
    try:
        with path.open("rb") as file:
            header = read_header(path, file)
            _check_properties(path, header, required)
            _check_size(path, header, file)
            if header.format == ASCII:
                return _text_rows(path, header, file)
            return np.fromfile(file, dtype=header.dtype, count=header.count)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def write_vertices(path: Path, table: Table) -> None:
    """Write a structured array of little-endian float32 and uint8 columns as PLY, atomically."""
    columns: list[tuple[str, np.dtype[Any]]] = [
        (name, table.dtype[name]) for name in table.dtype.names or ()
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {NAMES[dtype]} {name}" for name, dtype in columns]
    with whole_file(path) as file:
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        table.tofile(file)


def _check_properties(path: Path, header: Header, required: Sequence[str]) -> None:
    missing = [name for name in required if name not in (header.dtype.names or ())]
    if missing:
        raise FieldFormatError(f"{path}: no vertex property {', '.join(missing)}")


def _check_size(path: Path, header: Header, file: BinaryIO) -> None:
    left_bytes = path.stat().st_size - file.tell()
    row_bytes = header.dtype.itemsize
    if header.format == ASCII:
        row_bytes = SHORTEST_VALUE_BYTES * len(header.dtype.names or ())
        left_bytes += 1  # the last row need not end with a newline
    if header.count * row_bytes > left_bytes:
        raise FieldFormatError(
            f"{path}: the header claims {header.count * row_bytes} bytes of vertices or more, "
            f"{left_bytes} follow it"
        )


def _text_rows(path: Path, header: Header, file: BinaryIO) -> Table:
    names = header.dtype.names or ()
    limit_bytes = LONGEST_VALUE_BYTES * len(names)
    table = np.empty(header.count, header.dtype)
    for start in range(0, header.count, ROWS_AT_ONCE):
        wanted = min(ROWS_AT_ONCE, header.count - start)
        lines = [line for _ in range(wanted) if (line := file.readline(limit_bytes))]
        values = _numbers(path, lines, start, len(names))
        if len(lines) < wanted:
            raise FieldFormatError(
                f"{path}: {start + len(lines)} rows, the header claims {header.count}"
            )
        with np.errstate(over="ignore"):
            for column, name in enumerate(names):
                table[name][start : start + len(lines)] = values[:, column]
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
