"""Tables hold every cell, and at 80 columns every row can be told from the others."""

import io
import re
from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from rfedge.report.tables import (
    text_table,
)

WIDTH = 80


def printed(
    title: str, headings: list[str], rows: Sequence[Sequence[str]], width: int = WIDTH
) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    text_table(headings, rows, title).print(console)
    text = console.file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    return str(text)


# --- what a row declares


def test_brackets_are_text_and_not_markup():
    assert "[bold]x[/]" in printed("[red]", ["a", "b"], [["[bold]x[/]", "1"], ["y", "2"]])
    assert "[red]" in printed("[red]", ["a"], [["x"], ["y"]])


LETTERS = st.text("abcdefgh0123456789.", min_size=1, max_size=12)


@given(
    st.integers(2, 9).flatmap(
        lambda n: st.lists(st.tuples(*[LETTERS] * n), min_size=2, max_size=6, unique=True)
    )
)
def test_rows_that_differ_are_printed_as_different_lines(rows):
    columns = [f"column{k}" for k in range(len(rows[0]))]
    text = printed("", columns, [list(row) for row in rows], width=400)
    lines = [tuple(re.findall(r"[\w.]+", x)) for x in text.splitlines() if x.startswith("│")]
    varying = [k for k in range(len(columns)) if len({row[k] for row in rows}) > 1]
    assert lines == [tuple(row[k] for k in varying) for row in rows]
