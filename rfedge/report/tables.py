"""Tables of results: as Markdown for the generated pages, as text for a terminal.

A Markdown section begins with ``heading``, which names command, revision and host. On a terminal,
columns that say the same in every row go into the caption, and what is wider than the terminal is
continued in a further table below, which repeats the columns that tell its rows apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfcore.errors import InvalidInput
from rfedge.results import Result

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["cell", "escaped", "heading", "print_table", "table"]

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
        _print_part(console, [columns[k] for k in part], part, rows)
    if same:
        console.print(f"In every row: {', '.join(same)}.", markup=False, highlight=False)


def _check(columns: Sequence[str], rows: Cells) -> None:
    if not columns:
        raise InvalidInput("columns", "a table needs at least one")
    for number, row in enumerate(rows):
        if len(row) != len(columns):
            raise InvalidInput("rows", f"row {number} has {len(row)} cells of {len(columns)}")


def _widths(columns: Sequence[str], rows: Cells) -> list[int]:
    return [
        max([len(name), *(len(row[k]) for row in rows)]) + BORDER for k, name in enumerate(columns)
    ]


def _keys(shown: Sequence[int], rows: Cells) -> list[int]:
    """Return the first columns, as many as it takes to tell the rows apart; else the first."""
    distinct = len({tuple(row) for row in rows})
    for count in range(1, len(shown)):
        keys = list(shown[:count])
        if len({tuple(row[k] for k in keys) for row in rows}) == distinct:
            return keys
    return list(shown[:1])


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


def _print_part(console: Console, names: Sequence[str], part: Sequence[int], rows: Cells) -> None:
    from rich.table import Table
    from rich.text import Text

    printed = Table()
    for name, column in zip(names, part, strict=True):
        is_number = all(row[column][:1] in "0123456789+-±." for row in rows)
        printed.add_column(Text(name), justify="right" if is_number else "left", overflow="fold")
    for row in rows:
        printed.add_row(*(Text(row[column]) for column in part))
    console.print(printed)
