"""The header of a PLY file: how many vertices there are and what a row of them holds.

PLY as described by G. Turk, "The PLY Polygon File Format", 1994. Read here: any of its three
formats, ``element vertex`` first, scalar properties in any order; further elements are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rfcore.errors import FieldFormatError

__all__ = ["ASCII", "Header", "read_header"]

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
    """What a header says: the format's name, the number of vertices, the dtype of a row."""

    format: str
    count: int
    dtype: np.dtype[Any]


def read_header(path: Path, file: BinaryIO) -> Header:
    """Read up to and including ``end_header``; the file is left at the first row.

    Raises ``FieldFormatError`` naming the file and the line at fault.
    """
    lines = _lines(path, file)
    words = [line.split() for line in lines[1:-1]]
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
    return Header(form, _row_count(path, words[1]), _row_dtype(path, words[2:end], ORDERS[form]))


def _lines(path: Path, file: BinaryIO) -> list[str]:
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


def _check_first_element(path: Path, words: list[list[str]], elements: list[int]) -> None:
    first = words[elements[0]][1:2] if elements else []
    if first == ["chunk"]:
        raise FieldFormatError(
            f"{path}: a compressed .ply of PlayCanvas or SuperSplat; export it there as plain .ply"
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
