"""The result of a load test has what was measured; the search finds the limit."""

import io
import json
import math
import re
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from load_runs import load_run
from rfedge.loadtest.run import (
    LoadResult,
    LoadRow,
    largest_held,
    latency_chart,
    print_runs,
    write_load_result,
)
from rfedge.results import read_result, rows_of

# --- the search


@given(st.integers(1, 40), st.integers(0, 1200))
def test_the_largest_number_is_found_within_a_tenth(first, true_limit):
    asked: list[int] = []

    def held(vehicles: int) -> bool:
        asked.append(vehicles)
        return vehicles <= true_limit

    found = largest_held(first, held, most=1000)
    assert len(asked) == len(set(asked))
    reachable = min(true_limit, 1000)
    assert found <= reachable
    assert reachable < max(found + 1, 1.1 * found) or reachable == found


# --- files


def test_the_files_say_what_was_measured(tmp_path):
    result = LoadResult([load_run(4, held=True), load_run(8, held=False)])
    write_load_result(result, tmp_path)
    content = read_result(tmp_path / "result.json", "loadtest")
    assert [(row["vehicles"], row["held"]) for row in content["rows"]] == [(4, True), (8, False)]
    assert rows_of(LoadRow, content["rows"])[0].p99_ms == 130.0
    page = (tmp_path / "report.html").read_text()
    assert "4 vehicles held (receiver, 640x360, 10 Hz)" in page
    assert "p99 130 ms above 100 ms" in page
    assert "limit of 4" in page
    assert "limit of 8" in page
    assert page.count("<svg") == 1
    assert re.findall(r"(?:src|href)=.(?!data:|#)[^>]*", page) == [], "the page is self-contained"


def test_what_nothing_was_measured_of_is_null_and_a_dash(tmp_path):
    run = load_run(8, held=False)
    verdict = replace(run.verdict, p50_ms=math.inf, p99_ms=math.inf)
    row = replace(run.row, p50_ms=None, p99_ms=None)
    result = LoadResult([replace(run, verdict=verdict, row=row)])
    write_load_result(result, tmp_path)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["rows"][0]["p99_ms"] is None
    assert "<td>-</td><td>-</td>" in (tmp_path / "report.html").read_text()


def test_text_of_a_run_cannot_break_the_page(tmp_path):
    run = load_run(8, held=False)
    row = replace(run.row, broken=["<script>x</script>"], limited_by="a & b")
    write_load_result(LoadResult([replace(run, row=row)]), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "a &amp; b" in page


@pytest.mark.parametrize(
    ("runs", "headline"),
    [
        ([(1, True)], "1 vehicle held (receiver, 640x360, 10 Hz)"),
        ([(4, False)], "4 vehicles not held (receiver, 640x360, 10 Hz)"),
        ([(4, True), (6, True), (8, False)], "6 vehicles held (receiver, 640x360, 10 Hz)"),
        ([(4, False), (8, False)], "0 vehicles held (receiver, 640x360, 10 Hz)"),
    ],
)
def test_the_headline_names_the_largest_number_that_held(runs, headline):
    result = LoadResult([load_run(count, held=held) for count, held in runs])
    assert result.headline() == headline


# --- tables


def test_at_80_columns_each_run_is_on_a_line_with_its_number_and_verdict():
    console = Console(file=io.StringIO(), width=80)
    print_runs(console, LoadResult([load_run(4, held=True), load_run(8, held=False)]))
    text = console.file.getvalue()
    assert "4 vehicles held (receiver, 640x360, 10 Hz)" in text
    assert re.search(r"^ +4 +yes", text, re.MULTILINE)
    assert re.search(r"^ +8 +no", text, re.MULTILINE)
    assert "In every row: answered 790 of 800, p50 ms 20.5, p99 ms 130.0" in " ".join(text.split())


def test_the_last_line_says_why_the_smallest_load_was_not_held():
    runs = [load_run(count, held=count < 8) for count in (4, 8, 16)]
    row = replace(runs[1].row, refused=3, failed=1, reduced=2)
    runs[1] = replace(runs[1], row=row)
    console = Console(file=io.StringIO(), width=80)
    print_runs(console, LoadResult(runs))
    *_, last = re.split(r"\n\s*\n", console.file.getvalue().strip())
    text = " ".join(last.split())
    assert text.startswith("8 vehicles not held: p99 130 ms above 100 ms")
    for said in (
        "3 vehicles refused",
        "1 vehicle failed",
        "2 vehicles at a lower rate",
        "limit of 8",
    ):
        assert said in text


# --- charts


def test_a_curve_of_latency_for_each_run_and_the_deadline():
    """A run without an Ack has an empty curve and its name."""
    svg = latency_chart({"4 vehicles": [10.0, 900.0], "8 vehicles": []}, 100.0, "4 cameras at 5 Hz")
    texts = ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
    shown = " ".join("".join(node.itertext()).strip() for node in texts)
    for name in ("4 vehicles", "8 vehicles", "deadline", "4 cameras at 5 Hz", "20", "200", "500"):
        assert name in shown
