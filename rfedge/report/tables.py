"""Tables of rows, declared once and shown on a terminal and on a Markdown page.

A row is a frozen dataclass. Each field that is shown carries its heading, with the unit, and its
format (``shown``). A ``Table`` names the columns that it shows: fields, or values that are computed
from a row (``Column``)::

    @dataclass(frozen=True)
    class Row:
        drive: str = field(metadata=shown("drive"))
        kbit: float | None = field(metadata=shown("kbit a frame", ".1f"))

    Table("Bits", columns(Row), rows).print(console)

Columns without any value are left out, and values that are the same in every row go into a line
below. A terminal shows a line for each row: those that tell the rows apart, and as many of the
other columns, the first before the last, as fit; a line below names the rest. On a page, columns
beyond ``PAGE_COLUMNS`` continue in a further table, which repeats those that tell its rows apart.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any

from rfcore.errors import InvalidInput

if TYPE_CHECKING:
    from rich.console import Console

PAGE_COLUMNS = 8
"""Largest number of columns that fit a screen."""
BORDER = 2
"""Spaces between the columns of a terminal's table."""
SHOWN = "shown"
Cells = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Column:
    """A column: its heading, and the value that it shows of a row.

    ``form``: a format specification (``.1f``), or a text with braces for a value of several parts
    (``{:.0f} / {:.0f}``); without one ``cell`` formats the value. ``missing`` stands for None.
    """

    heading: str
    value: Callable[[Any], Any]
    form: str = ""
    missing: str = "-"

    def text(self, row: object) -> str:
        """Return what a table shows of ``row``."""
        value = self.value(row)
        if value is None:
            return self.missing
        if "{" in self.form:
            return self.form.format(*value)
        return format(value, self.form) if self.form else cell(value)


def shown(heading: str, form: str = "", missing: str = "-") -> Mapping[str, Any]:
    """Return the metadata of a field that tables show; see ``Column``."""
    return {SHOWN: (heading, form, missing)}


def columns(row_type: type[Any], *wanted: str | Column) -> list[Column]:
    """Return columns for rows of a dataclass: those named or given, or all fields that are shown.

    Raises ``InvalidInput`` for a name that is no shown field.
    """
    declared = {
        each.name: each.metadata[SHOWN] for each in fields(row_type) if SHOWN in each.metadata
    }
    found = []
    for each in wanted or declared:
        if isinstance(each, str) and each not in declared:
            raise InvalidInput("columns", f"{row_type.__name__} shows no field {each!r}")
        found.append(_column_of(each, *declared[each]) if isinstance(each, str) else each)
    return found


def _column_of(name: str, heading: str, form: str, missing: str) -> Column:
    return Column(heading, attrgetter(name), form, missing)


def named_columns(names: Iterable[str]) -> list[Column]:
    """Return a column for each name, of rows that are mappings."""
    return [Column(name.replace("_", " "), _item_of(name)) for name in names]


def _item_of(name: str) -> Callable[[Any], Any]:
    return lambda row: row.get(name)


def cell(value: Any) -> str:
    """Return a value as a table shows it if nothing else is said."""
    if value is None:
        return "not run"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 0.01 else f"{value:.2f}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {cell(inner)}" for name, inner in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "..".join(map(cell, value))
    return str(value)


@dataclass(frozen=True)
class Table:
    """Rows under columns; raises ``InvalidInput`` without a column.

    ``title``: a line above the table, or nothing.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Any]

    def __post_init__(self) -> None:
        if not self.columns:
            raise InvalidInput("columns", "a table needs at least one")

    @property
    def headings(self) -> list[str]:
        """The heading of each column."""
        return [column.heading for column in self.columns]

    @property
    def cells(self) -> list[list[str]]:
        """The text of each row's cells."""
        return [[column.text(row) for column in self.columns] for row in self.rows]

    def print(self, console: Console) -> None:
        """Print the table so that its rows can be told apart at the width of ``console``."""
        cells = self.cells
        varying, same = self._varying(cells)
        widths = _widths(self.headings, cells)
        if self.title:
            console.print(self.title, markup=False, highlight=False, style="italic")
        fitting = _parts(varying, cells, widths, console.width + BORDER)[0]
        self._print_part(console, fitting, widths, cells)
        left_out = ", ".join(self.headings[k] for k in varying if k not in fitting)
        for told, what in (("In every row", same), (f"Wider than {console.width}", left_out)):
            if what:
                console.print(f"{told}: {what}.", markup=False, highlight=False)
        console.print()

    def markdown(self) -> str:
        """Return the table in Markdown, its first column aligned left and the others right."""
        cells = self.cells
        varying, same = self._varying(cells)
        parts = _parts(varying, cells, [1] * len(self.columns), PAGE_COLUMNS)
        texts = [_markdown(self.headings, part, cells) for part in parts]
        above = [self.title] if self.title else []
        below = [f"In every row: {same}."] if same else []
        return "\n\n".join([*above, *texts, *below])

    def _varying(self, cells: Cells) -> tuple[list[int], str]:
        """Return the columns that differ between rows, and in words those that do not."""
        every = [
            k
            for k, column in enumerate(self.columns)
            if not cells or any(row[k] != column.missing for row in cells)
        ]
        varying = [k for k in every if len({row[k] for row in cells}) > 1]
        if not varying:
            return every or list(range(len(self.columns))), ""
        same = [f"{self.headings[k]} {cells[0][k]}" for k in every if k not in varying]
        return varying, ", ".join(same)

    def _print_part(
        self, console: Console, part: Sequence[int], widths: Sequence[int], cells: Cells
    ) -> None:
        import rich.box
        import rich.table
        from rich.text import Text

        printed = rich.table.Table(
            box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, BORDER - 1, 0, 0)
        )
        for k in part:
            header = Text(_broken(self.headings[k], widths[k] - BORDER))
            is_number = all(row[k][:1] in "0123456789+-±." for row in cells)
            printed.add_column(header, justify="right" if is_number else "left", overflow="fold")
        for row in cells:
            printed.add_row(*(Text(row[k]) for k in part))
        console.print(printed)


Parts = Callable[[Mapping[str, Any]], Iterable[Table | str]]
"""Returns what is shown of a result: paragraphs and tables."""


def print_tables(parts: Iterable[Table | str], console: Console) -> None:
    """Print the tables and paragraphs of a result."""
    for part in parts:
        if isinstance(part, Table):
            part.print(console)
        else:
            console.print(part, markup=False, highlight=False)


def text_table(headings: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> Table:
    """Return a table of texts; raise ``InvalidInput`` for a row of another length."""
    rows = list(rows)
    for number, row in enumerate(rows):
        if len(row) != len(headings):
            raise InvalidInput("rows", f"row {number} has {len(row)} cells of {len(headings)}")
    made = [Column(heading, itemgetter(k)) for k, heading in enumerate(headings)]
    return Table(title, made, rows)


def _markdown(headings: Sequence[str], part: Sequence[int], cells: Cells) -> str:
    lines = [[headings[k] for k in part], ["---", *["---:"] * (len(part) - 1)]]
    lines += [[row[k] for k in part] for row in cells]
    return "\n".join("| " + " | ".join(map(_escaped, line)) + " |" for line in lines)


def _escaped(text: str) -> str:
    """Return ``text`` so that it stays within its cell of a Markdown table."""
    return text.replace("|", r"\|").replace("\n", " ")


def _widths(headings: Sequence[str], cells: Cells) -> list[int]:
    """Return the characters that each column needs, its heading broken where it can be."""
    parts = [[*_heading_parts(h), *(row[k] for row in cells)] for k, h in enumerate(headings)]
    return [max(len(text.rstrip()) for text in texts) + BORDER for texts in parts]


def _heading_parts(heading: str) -> list[str]:
    """Return a heading broken after every space and dot: ``sender_ms.``, ``render``."""
    return re.findall(r"[^ .]*(?:\.| |$)", heading)[:-1] or [heading]


def _broken(heading: str, width: int) -> str:
    """Return a heading in as many lines as it takes within ``width``."""
    lines = [""]
    for part in _heading_parts(heading):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def _keys(varying: Sequence[int], cells: Cells) -> list[int]:
    """Return the first columns that tell the rows apart, none of them needless."""

    def told_apart(chosen: Sequence[int]) -> int:
        return len({tuple(row[k] for k in chosen) for row in cells})

    distinct = told_apart(varying)
    counts = range(1, len(varying) + 1)
    keys = list(varying[: next(n for n in counts if told_apart(varying[:n]) == distinct)])
    for key in reversed(keys.copy()):
        without = [k for k in keys if k != key]
        if without and told_apart(without) == distinct:
            keys = without
    return keys


def _parts(
    varying: Sequence[int], cells: Cells, widths: Sequence[int], most: int
) -> list[list[int]]:
    """Return the columns of each table: the keys, and as many others as fit, at least one."""
    if sum(widths[k] for k in varying) <= most:
        return [list(varying)]
    keys = _keys(varying, cells)
    parts = [list(keys)]
    for column in (k for k in varying if k not in keys):
        wide = sum(widths[k] for k in (*parts[-1], column)) > most
        if wide and len(parts[-1]) > len(keys):
            parts.append(list(keys))
        parts[-1].append(column)
    return parts
