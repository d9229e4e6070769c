"""Tables hold every cell, and at 80 columns every row can be told from the others."""

import io
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.report.tables import cell, escaped, heading, pivot, print_table, table

WIDTH = 80


def printed(title: str, columns: list[str], rows: list[list[str]], width: int = WIDTH) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=False)
    print_table(console, title, columns, rows)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= width
    return str(text)


# --- Markdown


def test_a_table_is_what_markdown_calls_one() -> None:
    assert table(("what", "ms"), [("render", "20"), ("code", "7")]) == (
        "| what | ms |\n| --- | ---: |\n| render | 20 |\n| code | 7 |"
    )


@given(st.lists(st.lists(st.text("ab|\n ", max_size=6), min_size=3, max_size=3), max_size=5))
def test_every_cell_stays_in_its_row_and_column(rows: list[list[str]]) -> None:
    lines = table(("a", "b", "c"), rows).split("\n")
    assert len(lines) == 2 + len(rows)
    for line, row in zip(lines[2:], rows, strict=True):
        cells = re.split(r"(?<!\\)\|", line)[1:-1]
        shown = [text.strip().replace(r"\|", "|") for text in cells]
        assert shown == [text.replace("\n", " ").strip() for text in row]


def test_a_cell_cannot_break_the_table() -> None:
    assert escaped("a|b\nc") == r"a\|b c"


@pytest.mark.parametrize(
    ("columns", "rows", "problem"),
    [((), [], "needs at least one"), (("a", "b"), [("1",)], "1 cells of 2")],
)
def test_a_table_without_form_is_refused(
    columns: tuple[str, ...], rows: list[tuple[str, ...]], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        table(columns, rows)
    with pytest.raises(InvalidInput, match=problem):
        print_table(Console(file=io.StringIO()), "", columns, rows)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "not run"),
        (1.25, "1.25"),
        (0.000123, "0.000123"),
        (-0.00456, "-0.00456"),
        (3, "3"),
        ("avx2", "avx2"),
        (True, "True"),
    ],
)
def test_a_value_is_shown_short(value: object, shown: str) -> None:
    assert cell(value) == shown


def test_a_heading_names_file_command_revision_and_host() -> None:
    host = {"cpu": "C", "cores": 2, "isa": "avx2"}
    result = {"command": "rfedge eval x", "revision": "abc-dirty", "host": host}
    assert heading(Path("lab/results/x-2.json"), result) == (
        "## x-2\n\n`rfedge eval x` at `abc-dirty`; C, 2 cores, avx2."
    )


# --- terminal

MODES = ("degree 3", "degree 1", "degree 0", "antialiased", "depth and opacity")
COLUMNS = ["width", "height", "gaussians", "isa", "mode", "native_ms", "ratio"]
ROWS = [
    [f"{w}", f"{h}", "200000", "avx512-vnni", mode, f"{10 + k}.25", f"1.{k}"]
    for w, h in ((640, 360), (1920, 1080))
    for k, mode in enumerate(MODES)
]


def test_columns_that_say_the_same_in_every_row_go_into_the_caption() -> None:
    text = printed("modes", COLUMNS, ROWS)
    assert "In every row: gaussians 200000, isa avx512-vnni." in " ".join(text.split())
    assert text.count("200000") == text.count("avx512-vnni") == 1
    assert text.count("modes") == 1


def test_each_row_is_on_a_line_of_its_own_with_its_cells_whole() -> None:
    text = printed("", COLUMNS, ROWS)
    for width, height, _, _, mode, ms, _ in ROWS:
        (line,) = [x for x in text.splitlines() if f" {width} " in x and f" {mode} " in x]
        assert f" {height} " in line
        assert f" {ms} " in line


def test_a_table_wider_than_the_terminal_goes_on_below_with_its_keys() -> None:
    """As the codec bench: a dozen stages of both ends beside what tells the rows apart."""
    stages = [f"sender_ms.stage_{k:02d}" for k in range(12)]
    columns = ["threads", "width", "height", "references", *stages]
    rows = [
        [str(threads), str(width), str(width // 2), str(references)]
        + [f"{threads}{width}.{references}{k}" for k in range(12)]
        for threads in (1, 2)
        for width in (640, 1280)
        for references in (1, 3)
    ]
    text = printed("codec", columns, rows)
    for stage in stages:
        assert text.count(stage.split(".")[1]) == 1, "every column is shown once"
    for row in rows:
        threads, width, _, references = row[:4]
        for value in row[4:]:
            (line,) = [x for x in text.splitlines() if f" {value} " in x]
            keys = re.findall(r"[\w.]+", line)[:3]
            assert keys == [threads, width, references], "beside what tells the row apart"
    assert text.count("height") == 1, "it follows from the width"


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("sender_ms.render", ["sender_ms.", "render"]),
        ("p99 <= 5 ms, Mbit/s", ["p99 <= 5", "ms, Mbit/s"]),
        ("scene", ["scene"]),
        ("a.b", ["a.b"]),
    ],
)
def test_a_long_header_is_broken_after_dots_and_spaces_alone(name: str, lines: list[str]) -> None:
    rows = [["x", "1234567890"[: len(lines[-1])]], ["y", "2"]]
    text = printed("", ["key", name], rows)
    head = text.split("┡")[0].splitlines()[1:]
    assert [line.split("┃")[2].strip() for line in head] == lines


def test_one_row_keeps_all_its_columns() -> None:
    text = printed("soak", ["minutes", "held"], [["30", "yes"]])
    assert "minutes" in text
    assert "In every row" not in text


def test_no_rows_are_a_table_of_headers() -> None:
    assert "BD-rate" in printed("nothing", ["scene", "BD-rate %"], [])


def test_a_cell_longer_than_the_terminal_is_folded_not_cut() -> None:
    reason = "no drive with a lane offset was given (--lane NAME@HZ=DATASET) " * 3
    text = printed("", ["condition", "level"], [["lane", reason], ["light", "dusk"]])
    assert "".join(reason.split()) in re.sub(r"[\s│┃]", "", text).replace("lane", "", 1)


def test_a_pivot_has_a_line_and_a_column_in_the_order_in_which_each_was_seen() -> None:
    cells = [("b", "y", "1"), ("b", "x", "2"), ("a", "x", "3"), ("a", "z", "4")]
    assert pivot("who", cells).splitlines() == [
        "| who | y | x | z |",
        "| --- | ---: | ---: | ---: |",
        "| b | 1 | 2 | - |",
        "| a | - | 3 | 4 |",
    ]


def test_brackets_are_text_and_not_markup() -> None:
    assert "[bold]x[/]" in printed("[red]", ["a", "b"], [["[bold]x[/]", "1"], ["y", "2"]])
    assert "[red]" in printed("[red]", ["a"], [["x"], ["y"]])


LETTERS = st.text("abcdefgh0123456789.", min_size=1, max_size=12)


@given(
    st.integers(2, 9).flatmap(
        lambda n: st.lists(st.tuples(*[LETTERS] * n), min_size=2, max_size=6, unique=True)
    )
)
def test_rows_that_differ_are_printed_as_different_lines(rows: list[tuple[str, ...]]) -> None:
    columns = [f"column{k}" for k in range(len(rows[0]))]
    text = printed("", columns, [list(row) for row in rows], width=400)
    lines = [tuple(re.findall(r"[\w.]+", x)) for x in text.splitlines() if x.startswith("│")]
    varying = [k for k in range(len(columns)) if len({row[k] for row in rows}) > 1]
    assert lines == [tuple(row[k] for k in varying) for row in rows]
