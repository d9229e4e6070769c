"""Recorded load tests: one file of the rows of many runs, and its section of the results page.

``python -m lab.pages.loads RECORD.json RESULT.json...`` puts the rows of results that
``rfedge loadtest`` wrote into ``RECORD.json``, in place of those of the same loads. Each row keeps
the command and the revision that made it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

from rfcore.errors import RfedgeError
from rfedge.loadtest.plan import Mode
from rfedge.loadtest.run import LoadRow
from rfedge.report.tables import cell, heading, table
from rfedge.results import Result, make_result, provenance, read_result, rows_of, write_result

__all__ = ["LimitRow", "RecordedLoad", "load_section", "ratio_section", "record"]

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
COLUMNS = (
    "mode",
    "vehicles",
    "cameras",
    "hz",
    "renderer",
    "link",
    "held",
    "p50_ms",
    "p99_ms",
    "on_time_percent",
    "on_time_at_least_percent",
    "fairness",
    "server_cores",
    "server_loop_cores",
    "vehicles_cores",
    "others_cores",
    "limited_by",
)


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


def load_section(path: Path, result: Result) -> str:
    """Return a table of the runs, with what was not kept and the commands below it."""
    rows = rows_of(RecordedLoad, result["rows"])
    cells = [[_shown(row, column) for column in COLUMNS] for row in rows]
    notes = "\n".join(_note(row) for row in rows)
    return "\n\n".join([heading(path, result), table(COLUMNS, cells), notes, ""])


@dataclass(frozen=True)
class LimitRow:
    """How many vehicles the code of a revision held, run by run, and what one costs its server."""

    code: str
    vehicles: tuple[int, ...]
    server_ms_a_frame: float


def ratio_section(path: Path, result: Result) -> str:
    """Return what two revisions carry, measured in turn, and the ratios of the second to the
    first."""
    rows = rows_of(LimitRow, result["rows"])
    before, now = rows
    cells = [
        (row.code, ", ".join(map(str, row.vehicles)), f"{row.server_ms_a_frame:.2f}")
        for row in rows
    ]
    held = median(now.vehicles) / max(1, median(before.vehicles))
    spent = before.server_ms_a_frame / now.server_ms_a_frame
    told = f"{held:.2f} times as many vehicles (medians); {spent:.2f} times as many frames a second"
    columns = ("code", "vehicles held", "server, ms a frame")
    return "\n\n".join(
        [heading(path, result), table(columns, cells), f"{told} of the server's processor.", ""]
    )


def _shown(row: LoadRow, column: str) -> str:
    if column == "link":
        return row.link or "loopback"
    if column == "held":
        return "yes" if row.held else "no"
    return cell(getattr(row, column))


def _note(row: RecordedLoad) -> str:
    broken = f" Not kept: {'; '.join(row.broken)}." if row.broken else ""
    size = f"{row.width}x{row.height}, {row.payload_bytes:.0f} bytes of payload a frame"
    return f"* `{row.command}` at `{row.revision}` ({row.kind} vehicles, {size}).{broken}"


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
