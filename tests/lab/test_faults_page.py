"""The committed page of faults is what the committed scoreboard says."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lab.pages.faults import ELSEWHERE, KINDS, FaultRow, LinkCell, faults_page
from rfcore.errors import InvalidInput
from rfedge.results import Provenance, make_result, write_result

ROOT = Path(__file__).parents[2]
HOST = {"cpu": "C", "cores": 2, "isa": "avx2"}
MADE = Provenance("make test-fault", "abc", False, HOST, {})
ROW = FaultRow("it breaks", "a hammer", "back <= 1 s; told so", "2.5 s; yes", passed=False)


def scoreboard(path: Path, *rows: Any, kind: str = "faults") -> Path:
    write_result(path, make_result(kind, MADE, {"rows": rows}))
    return path


def test_the_page_is_generated_from_the_scoreboard() -> None:
    page = (ROOT / "docs/reliability.md").read_text()
    assert page == faults_page(ROOT / "lab/results/faults.json"), "run `make figures`"


def test_a_row_shows_each_bound_beside_its_figure_and_a_miss_as_such(tmp_path: Path) -> None:
    page = faults_page(scoreboard(tmp_path / "faults.json", ROW))
    assert "0 of 1 hold. `make test-fault` at `abc`; C, 2 cores, avx2." in page
    assert "### it breaks: **does not hold**" in page
    assert "| back <= 1 s | 2.5 s |\n| told so | yes |" in page


def test_loads_are_counted_from_the_results_of_their_own_commands(tmp_path: Path) -> None:
    def run(name: str, held: bool, number: int | None) -> dict[str, Any]:
        command = f"rfedge loadtest --mode x --out out/loadtest/{name}"
        return {"command": command, "held": held, "run": number}

    rows = [run("full", True, None), run("full", True, 1), run("full", False, 2)]
    scoreboard(tmp_path / "loadtest.json", *rows, run("links", True, None), kind="loadtest")
    scoreboard(tmp_path / "soak.json", {"held": False}, kind="soak")
    fault = replace(ROW, covers="F1")
    page = faults_page(scoreboard(tmp_path / "faults.json", fault))
    assert "| L3 | load: full loop | `make load-full` | 1 of 2 |" in page
    assert "| `make load-links` | 1 of 1 |" in page
    assert "| `make load-overload` | **not recorded** |" in page
    assert "| L7 | soak | `make soak` | 0 of 1 |" in page
    assert "| F2 | vehicle killed | **not tested** |  |" in page


def test_every_row_appears_once_and_those_that_hold_are_counted(tmp_path: Path) -> None:
    rows = [FaultRow(f"fault {k}", f"tool {k}", "b", f"{k} ms", passed=k % 3 > 0) for k in range(7)]
    page = faults_page(scoreboard(tmp_path / "faults.json", *rows))
    assert "4 of 7 hold." in page
    assert page.count("### fault ") == 7
    for k, row in enumerate(rows):
        verdict = "holds" if row.passed else "**does not hold**"
        assert f"### fault {k}: {verdict}\n\ntool {k}\n" in page
        assert f"| b | {k} ms |" in page


def test_the_bounds_of_a_row_cannot_break_its_table(tmp_path: Path) -> None:
    row = FaultRow("a fault", "a | b", "x | y", "1 | 2", passed=True)
    page = faults_page(scoreboard(tmp_path / "faults.json", row))
    assert r"| x \| y | 1 \| 2 |" in page


def test_a_bound_without_a_figure_is_refused_by_the_faults_name(tmp_path: Path) -> None:
    row = FaultRow("it breaks", "a hammer", "back <= 1 s; told so", "2.5 s", passed=False)
    with pytest.raises(InvalidInput, match="it breaks: 2 bounds and 1 figures"):
        faults_page(scoreboard(tmp_path / "faults.json", row))


def test_another_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="of kind 'ladder', not 'faults'"):
        faults_page(scoreboard(tmp_path / "other.json", ROW, kind="ladder"))
    (tmp_path / "empty.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"empty\.json is no result file"):
        faults_page(tmp_path / "empty.json")


def test_a_row_that_lacks_its_verdict_is_refused(tmp_path: Path) -> None:
    row = {"fault": "f", "injected_with": "i", "bound": "b", "measured": "m"}
    with pytest.raises(InvalidInput, match="lacks passed"):
        faults_page(scoreboard(tmp_path / "faults.json", row))


def test_each_kind_of_fault_is_listed_with_the_rows_that_test_it(tmp_path: Path) -> None:
    rows = [
        FaultRow("it flaps", "ip link", "b", "1 s", passed=True, covers="F5 L5"),
        FaultRow("it flaps again", "ip link", "b", "9 s", passed=False, covers="F5"),
    ]
    page = faults_page(scoreboard(tmp_path / "faults.json", *rows))
    assert "| F5 | link that flaps | it flaps, it flaps again | 1 of 2 |" in page
    assert "| L5 | connection storm | it flaps | 1 of 1 |" in page
    assert "| F6 | packet loss x RTT x rate | **not tested** |" in page


def test_cells_of_the_matrix_are_a_table_by_loss_round_trip_and_rate(tmp_path: Path) -> None:
    cell = LinkCell(
        loss_percent=1,
        rtt_ms=300,
        rate_mbps=0.5,
        shown_hz=4.26,
        sent_mbps=0.123,
        frozen_percent=12.4,
        age_p50_ms=210.4,
        age_p99_ms=812.3,
        psnr_db=31.26,
    )
    dearer = replace(ROW, fault="it loses", cell=cell)
    without = replace(ROW, fault="it does not", cell=LinkCell(**{**cell, "loss_percent": 0}))
    page = faults_page(scoreboard(tmp_path / "faults.json", dearer, ROW, without))
    figures = "| 4.3 Hz | 0.12 Mbit/s | 12 % | 210 / 812 ms | 31.3 dB |"
    lines = [f"| {loss} % | 300 ms | 0.5 Mbit/s {figures}" for loss in (0, 1)]
    assert "\n".join(lines) in page


def test_without_a_cell_there_is_no_matrix(tmp_path: Path) -> None:
    assert "round trip" not in faults_page(scoreboard(tmp_path / "faults.json", ROW))


def test_every_kind_of_fault_has_a_case_that_names_it_or_a_command_that_measures_it() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "tests/fault").glob("test_*.py"))
    named = {kind for text in re.findall(r'"((?:[FL]\d+ ?)+)"', sources) for kind in text.split()}
    assert named <= set(KINDS)
    assert set(KINDS) - named - set(ELSEWHERE) == set()
