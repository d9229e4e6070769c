"""The result of a load test: what is written is what was measured, and rows are kept by load."""

import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.loadtest.plan import Load, Mode, Vehicles
from rfedge.loadtest.result import (
    LimitRow,
    LoadResult,
    latency_chart,
    load_section,
    print_runs,
    ratio_section,
    record,
    uplink_chart,
    write_load_result,
)
from rfedge.loadtest.run import LoadRow, Run
from rfedge.loadtest.verdict import Verdict
from rfedge.results import Provenance, make_result, read_result, rows_of, write_result

MADE = Provenance("rfedge loadtest --mode receiver", "abc123", False, {"cpu": "C"}, {})
HOST = {"cpu": "C", "cores": 2, "isa": "avx2"}


def row_of(**changes: object) -> LoadRow:
    row = LoadRow(
        mode="receiver",
        vehicles=8,
        hz=10.0,
        width=640,
        height=360,
        held=False,
        p50_ms=20.5,
        p99_ms=None,
        on_time_percent=97.25,
        on_time_at_least_percent=96.1,
        fairness=0.9,
        limited_by="server's workers",
        broken=["97.25 % on time, below 99 %"],
        kind="prerecorded",
        cameras=1,
        payload_bytes=4123.4,
        link=None,
        duration_s=20.0,
        vehicle_ms=0.0,
        admission=False,
        refused=0,
        failed=0,
        reduced=0,
        nacked=0,
        server_cores=1.5,
        server_loop_cores=0.25,
        vehicles_cores=0.1,
        links_cores=0.0,
        others_cores=0.0,
        server_growth_mb=0.5,
        generator_lag_ms=1.0,
    )
    return replace(row, **changes)  # type: ignore[arg-type]


def run_of(vehicles: int, *, held: bool, mode: Mode = Mode.RECEIVER, hz: float = 10.0) -> Run:
    broken = () if held else ("p99 130 ms above 100 ms",)
    verdict = Verdict(broken, 20.5, 130.0, 97.25, 96.1, 0.9, f"limit of {vehicles}")
    row = row_of(mode=str(mode), vehicles=vehicles, hz=hz, held=held, broken=broken, p99_ms=130.0)
    row = replace(row, limited_by=verdict.limited_by)
    latency_ms = [10.0 + k for k in range(20)]
    return Run(Load(mode, vehicles, hz), verdict, row, latency_ms, [4000, 4200], {})


# --- files


def test_the_files_say_what_was_measured(tmp_path: Path) -> None:
    result = LoadResult([run_of(4, held=True), run_of(8, held=False)])
    write_load_result(result, tmp_path)
    content = read_result(tmp_path / "result.json", "loadtest")
    assert [(row["vehicles"], row["held"]) for row in content["rows"]] == [(4, True), (8, False)]
    assert rows_of(LoadRow, content["rows"])[0].p99_ms == 130.0
    page = (tmp_path / "report.html").read_text()
    assert "4 vehicles held (receiver, 640x360, 10 Hz)" in page
    assert "p99 130 ms above 100 ms" in page
    assert "limit of 4" in page
    assert "limit of 8" in page
    assert page.count("<svg") == 2
    assert re.findall(r"(?:src|href)=.(?!data:|#)[^>]*", page) == [], "the page is self-contained"
    ElementTree.fromstring((tmp_path / "vehicles_vs_uplink.svg").read_text())


def test_what_nothing_was_measured_of_is_null_and_a_dash(tmp_path: Path) -> None:
    run = run_of(8, held=False)
    verdict = replace(run.verdict, p50_ms=math.inf, p99_ms=math.inf)
    row = replace(run.row, p50_ms=None, p99_ms=None)
    result = LoadResult([replace(run, verdict=verdict, row=row)])
    write_load_result(result, tmp_path)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["rows"][0]["p99_ms"] is None
    assert "<td>-</td><td>-</td>" in (tmp_path / "report.html").read_text()


def test_text_of_a_run_cannot_break_the_page(tmp_path: Path) -> None:
    run = run_of(8, held=False)
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
def test_the_headline_names_the_largest_number_that_held(
    runs: list[tuple[int, bool]], headline: str
) -> None:
    result = LoadResult([run_of(count, held=held) for count, held in runs])
    assert result.headline() == headline


# --- rows of several runs in one file


def test_a_recorded_row_is_replaced_by_the_same_load_and_kept_beside_others(
    tmp_path: Path,
) -> None:
    path = tmp_path / "loadtest.json"
    record(path, LoadResult([run_of(4, held=False, mode=Mode.FULL)]))
    record(path, LoadResult([run_of(4, held=True, mode=Mode.FULL)]))
    record(path, LoadResult([run_of(100, held=False, mode=Mode.TRANSPORT, hz=30.0)]))
    record(path, LoadResult([run_of(4, held=True, mode=Mode.FULL, hz=5.0)]))
    rows = rows_of(LoadRow, read_result(path, "loadtest")["rows"])
    assert [(row.mode, row.vehicles, row.hz, row.held) for row in rows] == [
        ("transport", 100, 30.0, False),
        ("full", 4, 5.0, True),
        ("full", 4, 10.0, True),
    ]
    assert all(row.command and row.revision for row in rows), "each says how it was made"


def test_rows_are_not_recorded_in_another_kind_of_file(tmp_path: Path) -> None:
    path = tmp_path / "compare.json"
    write_result(path, make_result("compare", MADE, {"rows": []}))
    before = path.read_bytes()
    with pytest.raises(InvalidInput, match="of kind 'compare', not 'loadtest'"):
        record(path, LoadResult([run_of(4, held=True)]))
    assert path.read_bytes() == before


# --- tables


def test_at_80_columns_each_run_is_on_a_line_with_its_number_and_verdict() -> None:
    console = Console(file=io.StringIO(), width=80)
    print_runs(console, LoadResult([run_of(4, held=True), run_of(8, held=False)]))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "4 vehicles held (receiver, 640x360, 10 Hz)" in text
    assert re.search(r"│ +4 │ yes", text)
    assert re.search(r"│ +8 │ no", text)
    assert "In every row: p50 ms 20.5, p99 ms 130.0" in text


def test_the_section_names_what_was_not_kept_and_its_command() -> None:
    rows = [row_of(command="rfedge loadtest --mode receiver", revision="abc123")]
    rows += [row_of(link="steady", held=True, broken=[], p99_ms=44.0, command="c", revision="r")]
    made = replace(MADE, host=HOST)
    section = load_section(Path("loadtest.json"), make_result("loadtest", made, {"rows": rows}))
    assert "| receiver | 8 | 1 | 10.00 | cpu | loopback | no | 20.50 | not run | 97.25 |" in section
    assert "| receiver | 8 | 1 | 10.00 | cpu | steady | yes | 20.50 | 44.00 | 97.25 |" in section
    assert "* `rfedge loadtest --mode receiver` at `abc123` (prerecorded vehicles, 640x360" in (
        section
    )
    assert section.count("Not kept: 97.25 % on time, below 99 %.") == 1


def test_the_ratio_of_two_revisions_is_made_from_their_rows(tmp_path: Path) -> None:
    rows = [LimitRow("0123456789ab", (2, 3, 2), 30.0), LimitRow("now", (6, 5, 6), 12.0)]
    path = tmp_path / "load-ratio.json"
    write_result(path, make_result("load-ratio", replace(MADE, host=HOST), {"rows": rows}))
    section = ratio_section(path, read_result(path, "load-ratio"))
    assert "| 0123456789ab | 2, 3, 2 | 30.00 |" in section
    assert "3.00 times as many vehicles (medians); 2.50 times as many frames a second" in section


# --- charts


def test_a_curve_of_latency_for_each_run_and_the_deadline() -> None:
    svg = latency_chart({"4 vehicles": [10.0, 20.0], "8 vehicles": [30.0]}, 100.0)
    shown = " ".join("".join(node.itertext()).strip() for node in _texts(svg))
    assert "4 vehicles" in shown
    assert "8 vehicles" in shown
    assert "deadline" in shown
    assert svg == latency_chart({"4 vehicles": [10.0, 20.0], "8 vehicles": [30.0]}, 100.0)


def test_a_run_without_an_ack_has_an_empty_curve_and_its_name() -> None:
    svg = latency_chart({"1 vehicle": []}, 100.0)
    assert "1 vehicle" in "".join("".join(node.itertext()) for node in _texts(svg))


def test_the_uplink_chart_labels_every_rate_and_says_where_it_stops() -> None:
    svg = uplink_chart([(1.0, 3), (2.0, 7), (64.0, 64)], 5, most=64)
    shown = [" ".join("".join(node.itertext()).split()) for node in _texts(svg)]
    for label in ("3", "7", "64+", "held by the server in this test: 5"):
        assert label in shown
    assert "held by the server" not in uplink_chart([(1.0, 3), (2.0, 7)], None, most=64)


def _texts(svg: str) -> list[ElementTree.Element]:
    return list(ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"))


def test_vehicles_are_prerecorded_or_live_and_nothing_else() -> None:
    assert [str(kind) for kind in Vehicles] == ["prerecorded", "live"]


def test_runs_of_one_load_are_rows_of_their_own_and_replace_those_before(tmp_path: Path) -> None:
    path = tmp_path / "loadtest.json"
    for on_time in (90.0, 99.5):
        rows = [row_of(run=n, on_time_percent=on_time + n / 10) for n in (1, 2, 3)]
        one = run_of(8, held=True)
        record(path, LoadResult([replace(one, row=row) for row in rows]))
    kept = rows_of(LoadRow, read_result(path)["rows"])
    assert [(row.run, row.on_time_percent) for row in kept] == [(1, 99.6), (2, 99.7), (3, 99.8)]
