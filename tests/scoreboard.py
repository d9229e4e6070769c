"""Rows of a long suite, written as they come: one that was broken off can be gone on with.

``--SUITE-json FILE`` writes the rows. With ``--resume``, cases whose row ``FILE`` has of the same
revision are not run again, and their rows stay.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from machine import Host, judge
from rfedge.results import make_result, provenance, revision, write_result

Row = dict[str, Any]


@dataclass(kw_only=True)
class Figures:
    """Figures of a case, each beside its bound; a case that was broken off does not hold."""

    bounds: list[str] = field(default_factory=list)
    measured: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    late: list[str] = field(default_factory=list)
    """Those of ``failed`` that are bounds of time."""
    finished: bool = False
    host: Host = field(default_factory=Host)

    def note(self, bound: str, measured: str, good: bool, is_timed: bool = False) -> None:
        """Note a figure and its bound."""
        self.bounds.append(bound)
        self.measured.append(measured)
        if not good:
            self.failed.append(f"{bound}: {measured}")
        if not good and is_timed:
            self.late.append(self.failed[-1])

    def tells(self, what: str, figure: str) -> None:
        """Note a figure without a bound."""
        self.note(what, figure, good=True)

    def finish(self) -> None:
        """Every figure is in: fail, or have it measured again, if one is out of bounds."""
        self.finished = True
        taken = self.host.taken()
        self.tells("of the processors the host gave to others", f"{taken:.1%}")
        judge(self.failed, self.late, taken)

    @property
    def held(self) -> bool:
        """Whether all figures are in, and within their bounds."""
        return self.finished and not self.failed

    def texts(self) -> Row:
        """Return ``bound`` and ``measured`` of the row."""
        end = [] if self.finished else [("measured to the end", "no")]
        every = [*zip(self.bounds, self.measured, strict=True), *end]
        bounds, measured = zip(*every, strict=True)
        return {"bound": "; ".join(bounds), "measured": "; ".join(measured)}


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
