"""The hard cases' result file, written by the very run that checks the cases.

``make stability`` runs them with ``--stability-json``; without it (``pytest -m hard``) nothing is
written.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

from hard.cases import CASES
from hard.cases.case import Case, Finding
from hard.cases.page import Row, case_row, stability_result, unmeasured
from rfedge.results import write_result

ROWS = pytest.StashKey[list[Row]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--stability-json", type=Path, help="write what came of every hard case here")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = []


@pytest.fixture
def record_finding(pytestconfig: pytest.Config) -> Callable[[Case, Finding], None]:
    """Note what a case came to, for the result file."""

    def record(case: Case, finding: Finding) -> None:
        pytestconfig.stash[ROWS].append(case_row(case, finding))

    return record


def pytest_sessionfinish(session: pytest.Session) -> None:
    json_path = session.config.getoption("--stability-json")
    if json_path is None:
        return
    rows = session.config.stash[ROWS]
    missing = unmeasured(CASES, rows)
    if missing:  # a result of some cases would look like one of all
        raise pytest.UsageError(
            f"{len(missing)} of {len(CASES)} hard cases gave no finding, such as {missing[0]!r}; "
            "nothing was written: run `make stability`"
        )
    write_result(json_path, stability_result(rows))
