"""Every recorded result renders, in tables that fit a screen."""

import json
import re
from typing import Any

import pytest

from lab.pages.__main__ import (
    KINDS,
    README_BEGINS,
    README_ENDS,
    Recorded,
    pages,
    recorded,
    with_headline,
    write_figures,
)
from lab.pages.suites import FAULTS, RESULTS, FaultRow
from rfcore.errors import InvalidInput
from rfedge.report.tables import PAGE_COLUMNS, Table
from rfedge.results import as_json


@pytest.fixture(scope="module")
def results() -> Recorded:
    return recorded()


def test_every_recorded_result_renders_in_tables_that_fit_a_screen(results):
    made = pages(results, {})
    for kind, named in results.items():
        page = made[kind]
        title, found, shows, *_ = page.split("\n\n")
        assert (title, shows) == (f"# {KINDS[kind].title}", KINDS[kind].shows)
        assert re.fullmatch(r"\*\*[^\n]*\d[^\n]*\.\*\*", found), "a sentence with a figure opens it"
        for name, result in named:
            assert f"\n## {name}\n" in page
            assert result["command"] in page
        widths = {
            len(re.split(r"(?<!\\)\|", line)) - 2 for line in page.splitlines() if line[:1] == "|"
        }
        assert max(widths, default=1) <= PAGE_COLUMNS, kind
    missing = {*KINDS, "index", "losses"} - set(made)
    assert missing <= {"soak", "webrtc"}, "each kind that is recorded has a page"
    assert all(f"]({name}.md)" in made["index"] for name in set(made) - {"index"})


def test_a_page_names_the_command_of_today(results):
    made = pages(results, {})
    assert "`rfedge eval paper` is now `rfedge-lab paper`" in made["paper"]
    assert "is now" not in made["compare"] + made["seams"]


@pytest.mark.slow
def test_the_committed_pages_and_figures_are_those_of_the_results(results, tmp_path):
    drawn = write_figures(results, tmp_path)
    for name, page in pages(results, drawn).items():
        assert (RESULTS / f"{name}.md").read_text() == page, "run `make figures`"
    for path in (path for files in drawn.values() for path in files):
        committed = RESULTS / "figures" / path.name
        assert committed.is_file(), "run `make figures`"
        if path.suffix == ".csv":
            assert committed.read_text() == path.read_text(), "run `make figures`"


def test_the_readme_gets_three_drives_and_the_loss_between_its_marks(results):
    page = with_headline(f"before\n{README_BEGINS}\nold\n{README_ENDS}\nafter\n", results)
    assert page.startswith(f"before\n{README_BEGINS}\n")
    assert page.endswith(f"{README_ENDS}\nafter\n")
    assert "old" not in page
    assert len([line for line in page.splitlines() if line[:1] == "|"]) == 2 + 3
    assert "in rain **" in page
    with pytest.raises(InvalidInput, match="it lacks"):
        with_headline("# A page\n", results)


def test_a_kind_that_nothing_shows_is_refused(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps({"kind": "weather"}))
    with pytest.raises(InvalidInput, match=r"x\.json: nothing shows kind 'weather'"):
        recorded(tmp_path)


ROW = FaultRow("it breaks", "a hammer", "back <= 1 s; told so", "2.5 s; yes", passed=False)


def test_a_fault_that_does_not_hold_stands_out_with_each_bound_beside_its_figure():
    score, *_, shown = FAULTS.parts({"rows": as_json([ROW])})
    assert score.startswith("Faults: 0 of 1.")
    assert "it breaks: **does not hold**" in shown
    assert "| back <= 1 s | 2.5 s |\n| told so | yes |" in str(shown)


def test_the_score_of_the_loads_is_the_sum_of_their_table(results):
    (score, *parts) = FAULTS.parts(dict(results["faults"][0][1]))
    tables = {part.title: part.cells for part in parts if isinstance(part, Table)}
    faults, loads = tables["Kinds of fault"], tables["Loads"]
    counted = [line[3] for line in loads if "of" in line[3].split()]
    held, runs = (sum(int(text.split(" of ")[k]) for text in counted) for k in (0, 1))
    assert f"{held} of {runs}" in score
    assert all(line[0] in score for line in loads if "not recorded" in line[3])
    assert not {line[0] for line in faults} & {line[0] for line in loads}


def test_a_bound_without_its_figure_is_refused():
    row: dict[str, Any] = {**as_json(ROW), "measured": "2.5 s"}
    with pytest.raises(InvalidInput, match="2 bounds and 1 figures"):
        list(FAULTS.parts({"rows": [row]}))
