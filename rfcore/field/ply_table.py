"""The vertex table of a binary PLY file, by property name.

PLY as described by G. Turk, "The PLY Polygon File Format", 1994: a text header, then the rows of
each element. Read here: ``format binary_little_endian 1.0``, ``element vertex`` first, scalar
properties in any order. Elements after the vertices are ignored. The row count is checked against
the size of the file before anything is allocated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import FieldFormatError
from rfcore.files import whole_file

__all__ = ["read_vertices", "write_vertices"]

MAX_HEADER_BYTES = 65_536
SPELLINGS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "<i2": ("short", "int16"),
    "<u2": ("ushort", "uint16"),
    "<i4": ("int", "int32"),
    "<u4": ("uint", "uint32"),
    "<f4": ("float", "float32"),
    "<f8": ("double", "float64"),
}
DTYPES = {name: code for code, names in SPELLINGS.items() for name in names}
NAMES = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar"}

Table = NDArray[np.void]


def read_vertices(path: Path, required: Sequence[str]) -> Table:
    """Return the vertices of a PLY file as a structured array [N].

    Raises ``FieldFormatError``, which names the file and what is wrong with it, when the header is
    not as described above, lacks a ``required`` property, or claims more rows than the file holds.
    """
    try:
        with path.open("rb") as file:
            count, dtype = _parse_header(path, _header_lines(path, file))
            _check_properties(path, dtype, required)
            _check_size(path, count * dtype.itemsize, file)
            return np.fromfile(file, dtype=dtype, count=count)
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


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    """Read up to and including ``end_header``; the file is left at the first row."""
    lines: list[str] = []
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        lines.append(line.decode("latin-1").strip())
        if lines[0] != "ply":
            raise FieldFormatError(f"{path}: does not start with 'ply'")
        if lines[-1] == "end_header":
            return lines
        if not line:
            break
    raise FieldFormatError(f"{path}: no 'end_header' in the first {MAX_HEADER_BYTES} bytes")


def _parse_header(path: Path, lines: list[str]) -> tuple[int, np.dtype[Any]]:
    """Return the number of vertices and the dtype of a row."""
    words = [line.split() for line in lines[1:-1]]
    words = [line for line in words if line and line[0] not in ("comment", "obj_info")]
    if not words or words[0] != ["format", "binary_little_endian", "1.0"]:
        found = " ".join(words[0]) if words else "nothing"
        raise FieldFormatError(
            f"{path}: '{found}' where 'format binary_little_endian 1.0' is needed; convert it"
        )
    elements = [i for i, line in enumerate(words) if line[0] == "element"]
    if not elements or elements[0] != 1 or words[1][1:2] != ["vertex"]:
        raise FieldFormatError(f"{path}: the first element must be 'vertex'")
    end = elements[1] if len(elements) > 1 else len(words)
    return _row_count(path, words[1]), _row_dtype(path, words[2:end])


def _row_count(path: Path, element: list[str]) -> int:
    if len(element) != 3 or not element[2].isascii() or not element[2].isdigit():
        raise FieldFormatError(f"{path}: '{' '.join(element)}' does not state a count")
    return int(element[2][:20])


def _row_dtype(path: Path, properties: list[list[str]]) -> np.dtype[Any]:
    columns: list[tuple[str, str]] = []
    for line in properties:
        if len(line) != 3 or line[0] != "property" or line[1] not in DTYPES:
            raise FieldFormatError(
                f"{path}: '{' '.join(line)}' is not a scalar property (lists are not read)"
            )
        columns.append((line[2], DTYPES[line[1]]))
    names = [name for name, _ in columns]
    if not names or len(set(names)) != len(names):
        raise FieldFormatError(f"{path}: vertex properties are missing or repeated")
    return np.dtype(columns)


def _check_properties(path: Path, dtype: np.dtype[Any], required: Sequence[str]) -> None:
    missing = [name for name in required if name not in (dtype.names or ())]
    if missing:
        raise FieldFormatError(f"{path}: no vertex property {', '.join(missing)}")


def _check_size(path: Path, needed_bytes: int, file: BinaryIO) -> None:
    left_bytes = path.stat().st_size - file.tell()
    if needed_bytes > left_bytes:
        raise FieldFormatError(
            f"{path}: the header claims {needed_bytes} bytes of vertices, {left_bytes} follow it"
        )
