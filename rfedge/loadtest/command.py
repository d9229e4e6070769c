"""What ``rfedge loadtest`` does: one run, or a search; then files and a table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from rfedge.loadtest.plan import Load
from rfedge.loadtest.result import LoadResult, record, write_result
from rfedge.loadtest.run import Run, TestBed, run_load
from rfedge.loadtest.uplink import largest_held

__all__ = ["Command"]


@dataclass(frozen=True)
class Command:
    """A load on a test bed; files go to ``out``, rows also to ``record``."""

    load: Load
    bed: TestBed
    out: Path
    record: Path | None = None

    def run(self, *, find_limit: bool) -> LoadResult:
        """Run once, or look for the limit; return what came of it."""
        console = Console()
        runs: list[Run] = []

        def held(vehicles: int) -> bool:
            console.print(f"[bold]{vehicles}[/] vehicles, {self.load.mode}, {self.load.hz:g} Hz")
            runs.append(run_load(replace(self.load, vehicles=vehicles), self.bed))
            console.print(f"  {_outcome(runs[-1])}")
            return runs[-1].verdict.held

        if find_limit:
            largest_held(self.load.vehicles, held)
        else:
            held(self.load.vehicles)
        result = LoadResult(sorted(runs, key=lambda run: run.load.vehicles))
        write_result(result, self.out)
        if self.record is not None:
            record(self.record, result.as_json())
        _print(console, result, self.out)
        return result


def _outcome(run: Run) -> str:
    verdict = run.verdict
    found = "held" if verdict.held else "not held: " + "; ".join(verdict.broken)
    return f"{found}; limit: {verdict.limited_by}"


def _print(console: Console, result: LoadResult, out: Path) -> None:
    table = Table(title=result.headline(), title_justify="left")
    for name in ("vehicles", "held", "p50 ms", "p99 ms", "on time %", "server cores", "limit"):
        table.add_column(name, justify="right")
    for run in result.runs:
        verdict = run.verdict
        table.add_row(
            str(run.load.vehicles),
            "yes" if verdict.held else "no",
            f"{verdict.p50_ms:.1f}",
            f"{verdict.p99_ms:.1f}",
            f"{verdict.on_time_percent:.2f}",
            f"{run.row['server_cores']:.2f}",
            verdict.limited_by,
        )
    console.print(table)
    for name in ("report.html", "result.json", "vehicles_vs_uplink.svg"):
        console.print(f"  {out / name}")
