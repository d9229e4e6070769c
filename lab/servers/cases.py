"""Cases and their bounds: the rows of ``rfedge-lab world`` and ``eval scale``, and their sections.

Each group of cases of ``eval scale`` takes minutes, so that a run may measure some of them and keep
the others' rows. Its result holds, next to the rows, which run each is of.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from lab.city.planned_load import PlannedRow
from rfcore.errors import InvalidInput
from rfedge.report.tables import cell, heading, print_table, table
from rfedge.results import Provenance, Result, make_result, read_result, rows_of, write_result

__all__ = [
    "Measured",
    "RayTiles",
    "ScaleRecord",
    "ScaleRow",
    "ScaleRun",
    "WorldRow",
    "print_scale",
    "print_world",
    "scale_section",
    "world_section",
]

SCALE = "scale"
COLUMNS = ("case", "bound", "measured", "held")
SAME_HOST = ("cpu", "cores")
"""What of two hosts must agree for their rows to stand in one table."""


@dataclass(frozen=True)
class ScaleRow:
    """A case: what was measured, and the most it may be."""

    case: str
    bound: float
    measured: float
    held: bool

    @staticmethod
    def at_most(case: str, bound: float, measured: float) -> ScaleRow:
        """Return the row of a case that is held if ``measured`` is not above ``bound``."""
        return ScaleRow(case, bound, measured, measured <= bound)


@dataclass(frozen=True)
class RayTiles:
    """The tiles that were trained on Ray."""

    tiles: int
    list_sha256: str
    """Of their ``tiles.json``, which names ground and pictures of each."""
    iterations: int
    """Of each tile."""


@dataclass(frozen=True)
class Measured:
    """What a group of cases measured."""

    rows: Sequence[ScaleRow]
    planning: Sequence[PlannedRow] = ()
    """Figures of planned loads, of which ``rows`` has the differences."""
    envoy_added_ms: Sequence[float] = ()
    """Of each pair of runs, straight and through Envoy: the difference of the two p99."""
    ray: Sequence[RayTiles] = ()
    """What the rows of Ray are of: one, or none."""


@dataclass(frozen=True)
class ScaleRun:
    """A run of the command, and the cases whose rows are of it."""

    command: str
    revision: str
    cases: Sequence[str]


@dataclass(frozen=True)
class ScaleRecord:
    """The rows so far; a case that is measured again replaces its row."""

    rows: Sequence[ScaleRow] = ()
    planning: Sequence[PlannedRow] = ()
    envoy_added_ms: Sequence[float] = ()
    ray: Sequence[RayTiles] = ()
    runs: Sequence[ScaleRun] = ()

    @staticmethod
    def read(path: Path, made: Provenance) -> ScaleRecord:
        """Return what a result file holds, nothing without one, to add a run ``made`` so to it.

        Raises ``InvalidInput`` for another kind of result, and for one of another host or input.
        """
        if not path.exists():
            return ScaleRecord()
        result = read_result(path, SCALE)
        _check_alike(path, result, made)
        return _record(result)

    def plus(self, made: Provenance, measured: Measured) -> ScaleRecord:
        """Return the record with the cases that a run measured."""
        plans = {(plan.vehicles, plan.figure): plan for plan in self.planning}
        return ScaleRecord(
            list(({row.case: row for row in (*self.rows, *measured.rows)}).values()),
            list((plans | {(p.vehicles, p.figure): p for p in measured.planning}).values()),
            measured.envoy_added_ms or self.envoy_added_ms,
            measured.ray or self.ray,
            self._runs_with(made, [row.case for row in measured.rows]),
        )

    def write(self, path: Path, made: Provenance) -> None:
        """Write the result file; its head is that of the last run."""
        content = {
            "rows": self.rows,
            "planning": self.planning,
            "envoy_added_ms": self.envoy_added_ms,
            "ray": self.ray,
            "runs": self.runs,
        }
        write_result(path, make_result(SCALE, made, content))

    def _runs_with(self, made: Provenance, cases: Sequence[str]) -> list[ScaleRun]:
        of_run: dict[tuple[str, str], list[str]] = {}
        for run in self.runs:
            kept = [case for case in run.cases if case not in cases]
            of_run.setdefault((run.command, run.revision), []).extend(kept)
        of_run.setdefault((made.command, made.revision), []).extend(cases)
        return [ScaleRun(*key, listed) for key, listed in of_run.items() if listed]


def _record(result: Result) -> ScaleRecord:
    return ScaleRecord(
        rows_of(ScaleRow, result["rows"]),
        rows_of(PlannedRow, result["planning"]),
        result["envoy_added_ms"],
        rows_of(RayTiles, result.get("ray", [])),  # older files do not say
        rows_of(ScaleRun, result["runs"]),
    )


def _check_alike(path: Path, result: Result, made: Provenance) -> None:
    there: Mapping[str, object] = {name: result["host"][name] for name in SAME_HOST}
    here = {name: made.host[name] for name in SAME_HOST}
    if there != here:
        raise InvalidInput("add", f"{path} was measured on {there}, not {here}; name another file")
    if result["inputs"] != dict(made.inputs):
        raise InvalidInput("add", f"{path} was measured with other inputs; name another file")


def print_scale(console: Console, rows: Sequence[ScaleRow]) -> None:
    """Print rows as a table."""
    print_table(console, "", COLUMNS, [_scale_cells(row) for row in rows])


def scale_section(path: Path, result: Result) -> str:
    """Return the rows, of which run each is, and how far the pairs of runs of Envoy spread."""
    record = _record(result)
    parts = [
        heading(path, result),
        "Several servers (`docs/how-to/servers.md`). *Bound*: the most that is accepted. All "
        "processes share the host.",
        table(COLUMNS, [_scale_cells(row) for row in record.rows]),
    ]
    added_ms = record.envoy_added_ms
    if added_ms:
        parts.append(
            f"Envoy added to the p99 in {len(added_ms)} pairs of runs: median "
            f"{statistics.median(added_ms):.2f} ms, {min(added_ms):.2f} to {max(added_ms):.2f} ms."
        )
    parts += [
        f"Ray: {of.tiles} tiles, {of.iterations} iterations each; the SHA-256 of their "
        f"`tiles.json` is `{of.list_sha256}`."
        for of in record.ray
    ]
    runs = (f"* `{x.command}` at `{x.revision}`: {'; '.join(x.cases)}." for x in record.runs)
    return "\n\n".join([*parts, "\n".join(runs), ""])


def _scale_cells(row: ScaleRow) -> list[str]:
    return [row.case, cell(row.bound), cell(row.measured), "yes" if row.held else "no"]


@dataclass(frozen=True)
class WorldRow:
    """A case of ``part``; ``held``: whether ``measured`` keeps ``bound``, None without a bound."""

    part: str
    case: str
    bound: str
    measured: str
    held: bool | None


def world_section(path: Path, result: Result) -> str:
    """Return the table."""
    notes = (
        "Objects and views of the twin against the generator's truth, of pictures as a server "
        "decodes them. *Distance from the outline*: of every confirmed object to the nearest "
        "vehicle on the ground, however far that is. *Found*: by an object of its own within 2 m "
        "of the outline, a vehicle's first pictures included. *The empty minute*: the drive "
        "through the empty street again and again, each time with other noise. *Dusk*: the "
        "generator's evening, in the light that the field learnt from another pass. *Gain*: PSNR "
        "of a view less that of the field alone."
    )
    cells = [_world_cells(row) for row in rows_of(WorldRow, result["rows"])]
    return "\n\n".join([heading(path, result), notes, table(COLUMNS, cells), ""])


def print_world(console: Console, result: Result) -> None:
    """Print the table."""
    cells = [_world_cells(row) for row in rows_of(WorldRow, result["rows"])]
    print_table(console, "The twin against the truth", COLUMNS, cells)


def _world_cells(row: WorldRow) -> list[str]:
    held = {True: "yes", False: "no", None: "-"}[row.held]
    return [f"{row.part}: {row.case}", row.bound or "-", row.measured, held]
