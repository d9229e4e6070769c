"""Live measurements: what is asked for is checked, what was measured is shown, memory is judged."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lab.live.report import AgeRow, IngestRow, SourceRow, live_section
from lab.live.run import LiveJob
from lab.live.showing import percentiles
from rfcore.errors import InvalidInput
from rfedge.results import Provenance, make_result, read_result, write_result

JOB = LiveJob(
    cameras=(1, 4),
    hz=2.0,
    seconds=10.0,
    rounds=1,
    consumers=10,
    sources=("rtsp",),
    source_seconds=300.0,
    kill_every_s=60.0,
    field=Path("f.rff"),
    drive=Path("d.json"),
    work=Path("work"),
    out=Path("live.json"),
)
AGES = [AgeRow(1, 2.0, 10.0, 20, 51.25, 98.5, 7250.0), AgeRow(4, 2.0, 10.0, 0, None, None, 3000.0)]
INGEST = [IngestRow(4, 2.0, 3, 10, 240, 239, 41.0, 80.0, 42.0, 83.0)]
SOURCES = [
    SourceRow(
        source="rtsp",
        seconds=300.0,
        kills=4,
        frames=2900,
        acked=2805,
        sender_report_percent=98.6,
        ack_median_ms=201.0,
        ack_p99_ms=402.0,
        shown_median_ms=203.0,
        shown_p99_ms=404.0,
        agent_mb=386.2,
        agent_mb_per_minute=0.254,
        server_mb=301.0,
        server_mb_per_minute=-0.1,
        threads_first=14,
        threads_last=14,
    )
]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"cameras": (0,)}, "not all within 1..64"),
        ({"hz": 0.0}, "hz: 0 is outside"),
        ({"source_seconds": float("nan")}, "source_seconds: nan"),
        ({"sources": ("v4l2",)}, "'v4l2' is none of rtsp, rtp"),
        ({"consumers": 51}, "51 is outside 0..50"),
        ({"out": Path("live.txt")}, "must end in .json"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_starts(
    change: dict[str, Any], problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem):
        replace(JOB, **change)


def section(tmp_path: Path, **parts: Any) -> str:
    made = Provenance("rfedge-lab live", "abc", False, {"cpu": "C", "cores": 2, "isa": "avx2"}, {})
    content = {"ages": [], "ingest": [], "sources": [], **parts}
    path = tmp_path / "live.json"
    write_result(path, make_result("live", made, content))
    return live_section(path, read_result(path, "live"))


def test_the_page_shows_every_figure(tmp_path: Path) -> None:
    page = section(tmp_path, ages=AGES, ingest=INGEST, sources=SOURCES)
    assert "| 1 | 2 | 20 | 51 | 98 | 7250 |" in page
    assert "| 4 | 2 | 0 | none | none | 3000 |" in page
    assert "| 4 | 2 | 10 | 240 / 239 | 41 | 80 | 42 | 83 |" in page
    assert "| rtsp | 300 | 4 | 2805 of 2900 | 99 | 201 | 402 | 203 | 404 | 386 | +0.25 |" in page


def test_a_part_that_was_not_measured_has_no_table(tmp_path: Path) -> None:
    page = section(tmp_path, ages=AGES)
    assert "From capture until a browser" in page
    assert "sender is killed" not in page


def test_percentiles_of_nothing_are_none() -> None:
    assert percentiles([]) == (None, None)
    assert percentiles([float(ms) for ms in range(101)]) == (50.0, 99.0)
