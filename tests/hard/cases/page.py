"""One run of the hard cases as a result; ``lab/results/stability.md`` shows it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hard.cases.case import Case, Finding
from rfedge.results import make_result, provenance

Row = Mapping[str, Any]


def stability_result(rows: Iterable[Row]) -> dict[str, Any]:
    """Return the result file of a run: the rows of its cases, with where they were taken."""
    return make_result("stability", provenance(command="make stability"), {"cases": list(rows)})


def case_row(case: Case, finding: Finding) -> Row:
    """Return what a case came to as a row of the result file."""
    return {
        "group": case.group,
        "name": case.name,
        "expected": case.expected,
        "got": finding.got,
        "holds": finding.holds,
        "error": finding.error,
        "limit": finding.limit,
    }


def unmeasured(cases: Sequence[Case], rows: Iterable[Row]) -> list[str]:
    """Return the names of the cases that no row tells of."""
    measured = {(row["group"], row["name"]) for row in rows}
    return [case.name for case in cases if (case.group, case.name) not in measured]
