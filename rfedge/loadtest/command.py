"""What ``rfedge loadtest`` runs: one load, or a search for the limit; then files and a table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from rfedge.loadtest.plan import Load
from rfedge.loadtest.planning import largest_held
from rfedge.loadtest.result import LoadResult, print_runs, record, write_load_result
from rfedge.loadtest.run import Run, TestBed, run_load

__all__ = ["Command"]


@dataclass(frozen=True)
class Command:
    """A load on a test bed; files go to ``out``, rows also to ``record`` if there is one."""

    load: Load
    bed: TestBed
    out: Path
    record: Path | None = None

    def run(self, *, find_limit: bool, repeated: int = 1) -> LoadResult:
        """Run ``repeated`` times, or search for the largest number of vehicles that is held."""
        console = Console()
        runs: list[Run] = []

        def held(vehicles: int) -> bool:
            console.print(f"[bold]{vehicles}[/] vehicles, {self.load.mode}, {self.load.hz:g} Hz")
            runs.append(run_load(replace(self.load, vehicles=vehicles), self.bed))
            console.print(f"  {_outcome(runs[-1])}")
            return runs[-1].verdict.held

        if find_limit:
            largest_held(self.load.vehicles, held)
        for _ in range(0 if find_limit else repeated):
            held(self.load.vehicles)
        if repeated > 1:
            runs = [replace(x, row=replace(x.row, run=n)) for n, x in enumerate(runs, 1)]
        result = LoadResult(sorted(runs, key=lambda run: run.load.vehicles))
        write_load_result(result, self.out)
        if self.record is not None:
            record(self.record, result)
        print_runs(console, result)
        for name in ("report.html", "result.json", "vehicles_vs_uplink.svg"):
            console.print(f"  {self.out / name}")
        return result


def _outcome(run: Run) -> str:
    verdict = run.verdict
    found = "held" if verdict.held else "not held: " + "; ".join(verdict.broken)
    return f"{found}; limit: {verdict.limited_by}"
