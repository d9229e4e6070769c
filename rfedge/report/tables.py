"""Tables of results: as Markdown for the generated pages, as text for a terminal.

A Markdown section begins with ``heading``, which names command, revision and host. On a terminal,
columns that say the same in every row go into the caption, and what is wider than the terminal is
continued in a further table below, which repeats the columns that tell its rows apart.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfcore.errors import InvalidInput
from rfedge.results import Result

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["cell", "escaped", "heading", "pivot", "plain_section", "print_table", "table"]

BORDER = 3
"""Characters a column of a terminal's table needs beside its text: two spaces and a line."""
Cells = Sequence[Sequence[str]]


def heading(path: Path, result: Result) -> str:
    """Return a section's title with the command, revision and host of its result."""
    host = result["host"]
    return (
        f"## {path.stem}\n\n`{result['command']}` at `{result['revision']}`; {host['cpu']}, "
        f"{host['cores']} cores, {host['isa']}."
    )


def cell(value: Any) -> str:
    """Return a value as a table shows it."""
    if value is None:
        return "not run"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 0.01 else f"{value:.2f}"
    return str(value)


def escaped(text: str) -> str:
    """Return ``text`` as one cell of a Markdown table: no column ends in it, no line breaks."""
    return text.replace("|", r"\|").replace("\n", " ")


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, its first column aligned left and the others right.

    Raises ``InvalidInput`` for no columns, and for a row of another length.
    """
    lines = [list(columns), ["---", *["---:"] * (len(columns) - 1)], *map(list, rows)]
    _check(columns, lines)
    lines = [[escaped(text) for text in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def pivot(first: str, cells: Iterable[tuple[str, str, str]]) -> str:
    """Return a Markdown table of (line, column, text), in the order in which each is seen first.

    ``first`` heads the lines; what no cell fills is a dash.
    """
    lines: dict[str, dict[str, str]] = {}
    for line, column, text in cells:
        lines.setdefault(line, {})[column] = text
    columns = list(dict.fromkeys(column for line in lines.values() for column in line))
    rows = ([name, *(line.get(each, "-") for each in columns)] for name, line in lines.items())
    return table((first, *columns), rows)


def plain_section(path: Path, result: Result) -> str:
    """Return every list of rows of a result as a table headed by the names of its fields.

    It shows results whose experiment is no longer here.
    """
    parts = [heading(path, result)]
    for name, rows in result.items():
        if isinstance(rows, list) and rows and isinstance(rows[0], dict):
            columns = list(dict.fromkeys(column for row in rows for column in row))
            cells = ([cell(row.get(column)) for column in columns] for row in rows)
            parts += [f"{name}:", table(columns, cells)]
    return "\n\n".join([*parts, ""])


def print_table(console: Console, title: str, columns: Sequence[str], rows: Cells) -> None:
    """Print rows so that each can be told from the others at the width of ``console``.

    Raises ``InvalidInput`` for no columns, and for a row of another length.
    """
    _check(columns, rows)
    varying = [k for k in range(len(columns)) if len({row[k] for row in rows}) > 1]
    shown = varying or list(range(len(columns)))
    same = [f"{columns[k]} {rows[0][k]}" for k in range(len(columns)) if rows and k not in shown]
    parts = _parts(shown, _keys(shown, rows), _widths(columns, rows), console.width)
    if title:
        console.print(title, markup=False, highlight=False, style="italic")
    for part in parts:
        _print_part(console, columns, part, rows)
    if same:
        console.print(f"In every row: {', '.join(same)}.", markup=False, highlight=False)


def _check(columns: Sequence[str], rows: Cells) -> None:
    if not columns:
        raise InvalidInput("columns", "a table needs at least one")
    for number, row in enumerate(rows):
        if len(row) != len(columns):
            raise InvalidInput("rows", f"row {number} has {len(row)} cells of {len(columns)}")


def _widths(columns: Sequence[str], rows: Cells) -> list[int]:
    """Return the characters that each column needs, its header broken where it can be."""
    parts = [[*_header_parts(name), *(row[k] for row in rows)] for k, name in enumerate(columns)]
    return [max(map(len, texts)) + BORDER for texts in parts]


def _header_parts(name: str) -> list[str]:
    """Return a column's name broken after every space and dot: ``sender_ms.``, ``render``."""
    return re.findall(r"[^ .]*(?:\.| |$)", name)[:-1] or [name]


def _header(name: str, width: int) -> str:
    """Return a column's name in as many lines as it takes within ``width``."""
    lines = [""]
    for part in _header_parts(name):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def _keys(shown: Sequence[int], rows: Cells) -> list[int]:
    """Return columns, the first ones there are, that tell the rows apart; none is needless."""

    def told_apart(columns: Sequence[int]) -> int:
        return len({tuple(row[k] for k in columns) for row in rows})

    distinct = told_apart(shown)
    counts = range(1, len(shown) + 1)
    keys = list(shown[: next(n for n in counts if told_apart(shown[:n]) == distinct)])
    for column in reversed(keys.copy()):
        without = [k for k in keys if k != column]
        if without and told_apart(without) == distinct:
            keys = without
    return keys


def _parts(
    shown: Sequence[int], keys: Sequence[int], widths: Sequence[int], most: int
) -> list[list[int]]:
    """Return the columns of each table: the keys, and as many others as fit, at least one."""
    if 1 + sum(widths[k] for k in shown) <= most:
        return [list(shown)]
    parts = [list(keys)]
    for column in (k for k in shown if k not in keys):
        wide = 1 + sum(widths[k] for k in (*parts[-1], column)) > most
        if wide and len(parts[-1]) > len(keys):
            parts.append(list(keys))
        parts[-1].append(column)
    return parts


def _print_part(console: Console, columns: Sequence[str], part: Sequence[int], rows: Cells) -> None:
    from rich.table import Table
    from rich.text import Text

    widths = _widths(columns, rows)
    printed = Table()
    for column in part:
        header = Text(_header(columns[column], widths[column] - BORDER))
        is_number = all(row[column][:1] in "0123456789+-±." for row in rows)
        printed.add_column(header, justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        printed.add_row(*(Text(row[column]) for column in part))
    console.print(printed)
