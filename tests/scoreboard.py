"""Rows of a long suite, written as they come: one that was broken off can be gone on with.

``--SUITE-json FILE`` writes the rows. With ``--resume``, cases whose row ``FILE`` has of the same
revision are not run again, and their rows stay.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from rfedge.results import make_result, provenance, revision, write_result

Row = dict[str, Any]


class Scoreboard:
    """The rows of the suite ``kind``; ``test`` of a row is the name of the case that made it."""

    def __init__(self, kind: str, command: str) -> None:
        self._kind = kind
        self._command = command
        self._path: Path | None = None
        self._rows: dict[str, list[Row]] = {}

    def options(self, parser: pytest.Parser) -> None:
        """Add the options; for ``pytest_addoption``."""
        parser.addoption(f"--{self._kind}-json", type=Path, help="write the rows here")
        with suppress(ValueError):  # another suite has added it
            parser.addoption("--resume", action="store_true", help="keep rows of this revision")

    def open(self, config: pytest.Config) -> None:
        """Take what is there already; for ``pytest_configure``."""
        self._path = config.getoption(f"--{self._kind}-json")
        if self._path is None or not config.getoption("--resume") or not self._path.exists():
            return
        result = json.loads(self._path.read_text())
        if result["revision"] == revision():
            for row in result["rows"]:
                self._rows.setdefault(row["test"], []).append(row)

    def leave_out(
        self, items: list[pytest.Item], here: Path, deselected: Callable[..., Any]
    ) -> None:
        """Drop the cases in the folder ``here`` that have rows."""
        done = [x for x in items if here in x.path.parents and x.name in self._rows]
        if done:
            deselected(items=done)
            items[:] = [x for x in items if x not in done]

    def add(self, test: str, rows: Sequence[Row]) -> None:
        """Take the rows of a case, print them, and write the file anew."""
        self._rows[test] = [{**row, "test": test} for row in rows]
        print(json.dumps(self._rows[test], indent=1))
        if self._path is not None:
            every = [row for rows in self._rows.values() for row in rows]
            made = provenance(command=self._command)
            write_result(self._path, make_result(self._kind, made, {"rows": every}))
