"""Tables hold every cell, and at 80 columns every row can be told from the others."""

import io
import re
from collections.abc import Sequence

from hypothesis import given, settings
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


@settings(max_examples=30)
@given(
    st.integers(2, 12).flatmap(
        lambda n: st.lists(st.tuples(*[LETTERS] * n), min_size=2, max_size=6, unique=True)
    ),
    st.sampled_from((WIDTH, 400)),
)
def test_a_row_is_a_line_and_what_does_not_fit_is_named(rows, width):
    columns = [f"column{k}" for k in range(len(rows[0]))]
    head, rest = printed("", columns, [list(row) for row in rows], width).split("─\n")
    lines = [tuple(re.findall(r"[\w.]+", line)) for line in rest.splitlines()[: len(rows)]]
    varying = [k for k in range(len(columns)) if len({row[k] for row in rows}) > 1]
    if width == WIDTH:
        assert len(set(lines)) == len(rows)
    else:
        assert lines == [tuple(row[k] for k in varying) for row in rows]
    assert all(column in head + rest for column in columns)
