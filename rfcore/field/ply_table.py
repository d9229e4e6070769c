"""The header and the tables of a PLY file (G. Turk, "The PLY Polygon File Format", 1994).

Read: any of the three formats, scalar properties in any order, elements in any order as long as no
list stands before the one that is read; comments are kept. Row counts are checked against the size
of the file before anything is allocated. Rows of text are one a line, with as many numbers as there
are properties; text of nine digits gives back the float32 it was written from.
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
VERTEX = "vertex"
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
class Element:
    """One table of a file; ``problem`` says why its rows cannot be read, if they cannot."""

    name: str
    count: int
    dtype: np.dtype[Any]
    problem: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties."""
        return self.dtype.names or ()


@dataclass(frozen=True)
class Header:
    """The header of a file: the format's name, its tables in order, where the first row is."""

    format: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    """The text after ``comment`` of each such line, in the order of the file."""
    start: int

    def element(self, name: str) -> Element | None:
        """Return the element of that name, None without one."""
        return next((element for element in self.elements if element.name == name), None)


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
    form = words[0][1]
    starts = [i for i, line in enumerate(words) if line[0] == "element"]
    if starts[:1] != [1]:
        raise FieldFormatError(f"{path}: no 'element' follows the format")
    elements = tuple(
        _element(path, words[i:end], ORDERS[form])
        for i, end in zip(starts, [*starts[1:], len(words)], strict=True)
    )
    return Header(form, elements, comments, file.tell())


def _lines(path: Path, file: BinaryIO) -> list[str]:
    lines: list[str] = []
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        lines.append(printable(line.decode("latin-1").strip()))
        if lines[0] != "ply":
            raise FieldFormatError(f"{path}: does not start with 'ply'")
        if lines[-1] == "end_header":
            return lines
        if not line:
            break
    raise FieldFormatError(f"{path}: no 'end_header' in the first {MAX_HEADER_BYTES} bytes")


def printable(text: str) -> str:
    """Return text whose control characters, which a terminal might obey, are question marks."""
    return "".join(c if c.isprintable() or c == "\t" else "?" for c in text)


def _element(path: Path, lines: list[list[str]], order: str) -> Element:
    """Return one element of its header lines; ``FieldFormatError`` without a count."""
    declared = lines[0]
    if len(declared) != 3 or not declared[2].isascii() or not declared[2].isdigit():
        raise FieldFormatError(f"{path}: '{' '.join(declared)}' does not state a count")
    name, count = declared[1], int(declared[2][:20])
    columns: list[tuple[str, str]] = []
    for line in lines[1:]:
        if len(line) != 3 or line[0] != "property" or line[1] not in DTYPES:
            problem = f"'{' '.join(line)}' is not a scalar property (lists are not read)"
            return Element(name, count, np.dtype([]), problem)
        columns.append((line[2], order + DTYPES[line[1]]))
    if len(dict(columns)) != len(columns):
        return Element(name, count, np.dtype([]), f"{name} properties are repeated")
    return Element(name, count, np.dtype(columns))


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
            header = read_header(path, file)
            vertex = checked_element(path, file, header, VERTEX, required)
            size_bytes = vertex.count * vertex.dtype.itemsize
            if size_bytes > DECODED_BYTES:
                raise FieldFormatError(
                    f"{path}: {vertex.count} vertices take {size_bytes / 1e9:.2f} GB, the limit "
                    f"is {DECODED_BYTES / 1e9:.2f} GB; write fewer points"
                )
            table = np.empty(vertex.count, vertex.dtype)
            for start, rows in read_rows(path, file, header, vertex):
                table[start : start + len(rows)] = rows
            return table
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def checked_element(
    path: Path, file: BinaryIO, header: Header, name: str, required: Sequence[str]
) -> Element:
    """Return an element that has the ``required`` properties and fits into the rest of the file.

    Raises ``FieldFormatError``.
    """
    element = header.element(name)
    if element is None:
        there = ", ".join(element.name for element in header.elements)
        raise FieldFormatError(f"{path}: no element '{name}' among its elements ({there})")
    until = header.elements[: header.elements.index(element) + 1]
    unread = (one for one in until if not one.names)
    problem = next((one.problem or f"{one.name} has no properties" for one in unread), None)
    if problem is not None:
        raise FieldFormatError(f"{path}: {problem}")
    missing = [key for key in required if key not in element.names]
    if missing:
        raise FieldFormatError(f"{path}: no {name} property {', '.join(missing)}")
    _check_size(path, header, until, file)
    return element


def read_rows(
    path: Path, file: BinaryIO, header: Header, element: Element
) -> Iterator[tuple[int, Table]]:
    """Yield (number of the first, rows) for a few thousand rows at a time, until all are read.

    ``element`` is one that was checked. Raises ``FieldFormatError``, ``OSError``.
    """
    file.seek(header.start)
    for earlier in header.elements[: header.elements.index(element)]:
        if header.format == ASCII:
            for _ in range(earlier.count):
                file.readline(LONGEST_VALUE_BYTES * len(earlier.names))
        else:
            file.seek(earlier.count * earlier.dtype.itemsize, os.SEEK_CUR)
    for start in range(0, element.count, ROWS_AT_ONCE):
        wanted = min(ROWS_AT_ONCE, element.count - start)
        read = _text_rows if header.format == ASCII else _binary_rows
        yield start, read(path, element, file, start, wanted)


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


def _check_size(path: Path, header: Header, elements: Sequence[Element], file: BinaryIO) -> None:
    left_bytes = file.seek(0, os.SEEK_END) - header.start
    row_bytes = [element.dtype.itemsize for element in elements]
    if header.format == ASCII:
        row_bytes = [SHORTEST_VALUE_BYTES * len(element.names) for element in elements]
        left_bytes += 1  # the last row need not end with a newline
    claimed_bytes = sum(e.count * size for e, size in zip(elements, row_bytes, strict=True))
    if claimed_bytes > left_bytes:
        raise FieldFormatError(
            f"{path}: the header claims {claimed_bytes} bytes of {elements[-1].name} or more, "
            f"{left_bytes} follow it"
        )


def _binary_rows(path: Path, element: Element, file: BinaryIO, start: int, wanted: int) -> Table:
    dtype = element.dtype
    data = file.read(wanted * dtype.itemsize)
    rows = len(data) // dtype.itemsize
    if rows < wanted:
        raise FieldFormatError(f"{path}: {start + rows} rows, the header claims {element.count}")
    return np.frombuffer(data, dtype)


def _text_rows(path: Path, element: Element, file: BinaryIO, start: int, wanted: int) -> Table:
    names = element.names
    limit_bytes = LONGEST_VALUE_BYTES * len(names)
    lines = [line for _ in range(wanted) if (line := file.readline(limit_bytes))]
    values = _numbers(path, lines, start, len(names))
    if len(lines) < wanted:
        raise FieldFormatError(
            f"{path}: {start + len(lines)} rows, the header claims {element.count}"
        )
    table = np.empty(wanted, element.dtype)
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
