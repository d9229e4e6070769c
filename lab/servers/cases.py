"""The rows of ``rfedge-lab world`` and ``rfedge-lab scale``: cases and their bounds.

Each group of cases of ``rfedge-lab scale`` takes minutes, so that a run may measure some of them
and keep the others' rows. Its result holds, next to the rows, which run each is of.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lab.city.planned_load import PlannedRow
from lab.report import Report, folded
from lab.servers import EvalScale
from rfcore.errors import InvalidInput
from rfedge.report.tables import Table, columns, shown
from rfedge.results import Provenance, Result, make_result, read_result, rows_of, write_result

KIND = "scale"
SAME_HOST = ("cpu", "cores")
"""Facts of two hosts that must agree for their rows to stand in one table."""


@dataclass(frozen=True)
class ScaleRow:
    """A case: what was measured, and the most it may be."""

    case: str = field(metadata=shown("case"))
    bound: float = field(metadata=shown("bound"))
    measured: float = field(metadata=shown("measured"))
    held: bool = field(metadata=shown("held"))

    @staticmethod
    def at_most(case: str, bound: float, measured: float) -> ScaleRow:
        """Return the row of a case that is held if ``measured`` is not above ``bound``."""
        return ScaleRow(case, bound, measured, measured <= bound)


@dataclass(frozen=True)
class RayTiles:
    """The tiles that were trained on Ray."""

    tiles: int
    list_sha256: str
    """Digest of their ``tiles.json``, which names ground and pictures of each."""
    iterations: int
    """Iterations of each tile."""


@dataclass(frozen=True)
class Measured:
    """The measurements of a group of cases."""

    rows: Sequence[ScaleRow]
    planning: Sequence[PlannedRow] = ()
    """Figures of planned loads; ``rows`` has their differences."""
    envoy_added_ms: Sequence[float] = ()
    """Difference of the p99 through Envoy and straight, for each pair of runs."""
    ray: Sequence[RayTiles] = ()
    """The tiles that the rows of Ray are of: one, or none."""


Case = Callable[[EvalScale], Measured]
"""Runs one group of cases, and returns what was measured."""


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
        result = read_result(path, KIND)
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
        write_result(path, make_result(KIND, made, content))

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


def scale_parts(result: Result) -> Iterator[Table | str]:
    """Yield the rows, of which run each is, and how far the pairs of runs of Envoy spread."""
    record = _record(result)
    yield "*Bound*: the most that is accepted. All processes share the host."
    yield Table("Several servers", columns(ScaleRow), record.rows)
    added_ms = record.envoy_added_ms
    if added_ms:
        yield (
            f"Envoy added to the p99 in {len(added_ms)} pairs of runs: median "
            f"{statistics.median(added_ms):.2f} ms, {min(added_ms):.2f} to {max(added_ms):.2f} ms."
        )
    for of in record.ray:
        yield (
            f"Ray: {of.tiles} tiles, {of.iterations} iterations each; the SHA-256 of their "
            f"`tiles.json` is `{of.list_sha256}`."
        )
    runs = (f"* `{x.command}` at `{x.revision}`: {'; '.join(x.cases)}." for x in record.runs)
    told = "\n".join(runs)
    yield folded("Which run each row is of", told)


SCALE = Report(
    KIND,
    "Several servers",
    "What becomes of streams when servers behind Envoy are killed, drained and added, when NATS is "
    "restarted, and of tiles that are trained on Ray.",
    scale_parts,
)


@dataclass(frozen=True)
class WorldRow:
    """A case of ``part``; ``held``: whether ``measured`` keeps ``bound``, None without a bound."""

    part: str = field(metadata=shown("part"))
    case: str = field(metadata=shown("case"))
    bound: str = field(metadata=shown("bound"))
    measured: str = field(metadata=shown("measured"))
    held: bool | None = field(metadata=shown("held"))


def world_parts(result: Result) -> Iterator[Table | str]:
    """Yield the rows, and the terms they use."""
    yield (
        "Objects and views of the twin against the generator's truth, of pictures as a server "
        "decodes them. *Distance from the outline*: of every confirmed object to the nearest "
        "vehicle on the ground, however far that is. *Found*: by an object of its own within 2 m "
        "of the outline, a vehicle's first pictures included. *The empty minute*: the drive "
        "through the empty street again and again, each time with other noise. *Dusk*: the "
        "generator's evening, in the light that the field learnt from another pass. *Gain*: PSNR "
        "of a view less that of the field alone."
    )
    rows = rows_of(WorldRow, result["rows"])
    yield Table("The twin against the truth", columns(WorldRow), rows)


WORLD = Report(
    "world",
    "The live twin against the truth",
    "How well the twin finds objects, how close its live views come to the street, and what they "
    "cost, against what the street generator knows.",
    world_parts,
)
