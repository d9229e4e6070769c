"""Recorded load tests: one file of the rows of many runs, and the pages that show them.

``python -m lab.pages.loads RECORD.json RESULT.json...`` puts the rows of results that
``rfedge loadtest`` wrote into ``RECORD.json``, in place of those of the same loads. Each row keeps
the command and the revision that made it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from lab.report import Report, bars, folded
from rfcore.errors import RfedgeError
from rfedge.loadtest.plan import Mode
from rfedge.loadtest.run import LoadRow
from rfedge.report.tables import Column, Table, text_table
from rfedge.results import Result, make_result, provenance, read_result, rows_of, write_result

KEY = (
    "mode",
    "kind",
    "vehicles",
    "cameras",
    "hz",
    "width",
    "height",
    "link",
    "vehicle_ms",
    "admission",
    "renderer",
    "threads",
    "run",
)
"""Fields that tell one load from another: a recorded row is replaced by one that has the same."""


@dataclass(frozen=True)
class RecordedLoad(LoadRow):
    """A row of a load test, with the command and the revision that made it."""

    command: str | None = None
    revision: str | None = None


def record(path: Path, result: Result) -> None:
    """Put the rows of a load test's result into the file at ``path``.

    Raises ``InvalidInput`` for a file that holds no load test.
    """
    made = {key: result[key] for key in ("command", "revision")}
    new = [replace(row, **made) for row in rows_of(RecordedLoad, result["rows"])]
    old = rows_of(RecordedLoad, read_result(path, "loadtest")["rows"]) if path.exists() else []
    replaced = {_key(row) for row in new}
    rows = sorted([row for row in old if _key(row) not in replaced] + new, key=_order)
    whole = make_result("loadtest", provenance(command="rfedge loadtest"), {"rows": rows})
    write_result(path, whole)


def _key(row: LoadRow) -> tuple[Any, ...]:
    return tuple(getattr(row, name) for name in KEY)


def _order(row: LoadRow) -> tuple[int, str, float, int, int]:
    return list(Mode).index(Mode(row.mode)), row.kind, row.hz, row.vehicles, row.run or 0


LOAD = (
    Column("mode", lambda row: row.mode),
    Column("vehicles", lambda row: row.vehicles),
    Column("cameras", lambda row: row.cameras),
    Column("Hz", lambda row: row.hz, "g"),
    Column("link", lambda row: row.link or "loopback"),
    Column("renderer", lambda row: row.renderer),
    Column("run", lambda row: row.run),
)
LOAD_LATENCY = (
    Column("held", lambda row: row.held),
    Column("p50 ms", lambda row: row.p50_ms, ".1f"),
    Column("p99 ms", lambda row: row.p99_ms, ".1f"),
    Column("on time %", lambda row: row.on_time_percent, ".2f"),
)
LOAD_CORES = (
    Column("fairness", lambda row: row.fairness, ".3f"),
    Column("server cores", lambda row: row.server_cores, ".2f"),
    Column("its loop", lambda row: row.server_loop_cores, ".2f"),
    Column("vehicles' cores", lambda row: row.vehicles_cores, ".2f"),
    Column("limited by", lambda row: row.limited_by),
)


def _load_parts(result: Result) -> Iterator[Table | str]:
    rows = rows_of(RecordedLoad, result["rows"])
    yield Table("Latency", (*LOAD, *LOAD_LATENCY), rows)
    yield Table("Processor time", (*LOAD, *LOAD_CORES), rows)
    notes = "\n".join(f"* {_load_note(row)}" for row in rows)
    yield folded("Commands, and what was not kept", notes)


def _load_note(row: RecordedLoad) -> str:
    broken = f" Not kept: {'; '.join(row.broken)}." if row.broken else ""
    size = f"{row.width}x{row.height}, {row.payload_bytes:.0f} bytes of payload a frame"
    return f"`{row.command}` at `{row.revision}` ({row.kind} vehicles, {size}).{broken}"


def _load_bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in rows_of(RecordedLoad, result["rows"]):
        if row.p99_ms is not None:
            yield f"{row.mode}, {row.vehicles} x {row.hz:g} Hz, {row.renderer}", row.p99_ms


@dataclass(frozen=True)
class LimitRow:
    """The vehicles that the code of a revision held, run by run, and the cost of one."""

    code: str
    vehicles: tuple[int, ...]
    server_ms_a_frame: float


def _ratio_parts(result: Result) -> Iterator[Table | str]:
    before, now = rows = rows_of(LimitRow, result["rows"])
    held = median(now.vehicles) / max(1, median(before.vehicles))
    spent = before.server_ms_a_frame / now.server_ms_a_frame
    lines = [
        (row.code, ", ".join(map(str, row.vehicles)), f"{row.server_ms_a_frame:.2f}")
        for row in rows
    ]
    yield text_table(
        ("code", "vehicles held", "server, ms a frame"), lines, "Two revisions in turn"
    )
    yield (
        f"{held:.2f} times as many vehicles (medians); {spent:.2f} times as many frames a second "
        "of the server's processor."
    )


LOADS = Report(
    "loadtest",
    "What a server carries",
    "Latency and processor time of a server under prerecorded and live vehicles.",
    _load_parts,
    bars("p99 ms from due to acknowledged", _load_bars),
)
RATIO = Report(
    "load-ratio",
    "What a server carries now and before",
    "How many vehicles two revisions of the server held, measured in turn.",
    _ratio_parts,
)


def main(arguments: list[str]) -> int:
    """Record from the command line; return 2 for a file that is no load test."""
    kept, *made = map(Path, arguments)
    try:
        for path in made:
            record(kept, read_result(path, "loadtest"))
    except (RfedgeError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
