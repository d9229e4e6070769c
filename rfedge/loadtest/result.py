"""``rfedge loadtest``: run a load, or search for the limit, and write and print the result.

The result is a JSON file, a page with a figure of the latencies, and a table on the terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from rich.console import Console

from rfedge.loadtest.plan import Load, Mode, Vehicles
from rfedge.loadtest.run import Run, TestBed, run_load
from rfedge.report.charts import RENDER, STYLE, new_axes, svg
from rfedge.report.page import write_page
from rfedge.report.tables import text_table
from rfedge.results import make_result, provenance, write_result

__all__ = [
    "LoadResult",
    "largest_held",
    "latency_chart",
    "print_runs",
    "run_loads",
    "write_load_result",
]

CLOSE = 1.1
"""The search stops at this ratio of its bounds: short runs on a noisy machine repeat no closer."""


def run_loads(
    load: Load, bed: TestBed, console: Console, *, find_limit: bool = False, repeated: int = 1
) -> LoadResult:
    """Run a load ``repeated`` times, or search for the largest number of vehicles that is held."""
    runs: list[Run] = []

    def held(vehicles: int) -> bool:
        console.print(f"[bold]{vehicles}[/] vehicles, {load.mode}, {load.hz:g} Hz")
        runs.append(run_load(replace(load, vehicles=vehicles), bed))
        verdict = runs[-1].verdict
        outcome = "held" if verdict.held else "not held: " + "; ".join(verdict.broken)
        console.print(f"  {outcome}; limit: {verdict.limited_by}")
        return verdict.held

    if find_limit:
        largest_held(load.vehicles, held)
    else:
        for _ in range(repeated):
            held(load.vehicles)
    if repeated > 1:
        runs = [replace(run, row=replace(run.row, run=n)) for n, run in enumerate(runs, 1)]
    return LoadResult(sorted(runs, key=lambda run: run.load.vehicles))


def largest_held(first: int, held: Callable[[int], bool], most: int = 1000) -> int:
    """Return the largest count for which ``held`` was true, 0 if it is for none up to ``first``.

    ``held`` is asked once for each count. The answer is exact below ten, and within a tenth above.
    """
    low, high = 0, first
    while high <= most and held(high):
        low, high = high, 2 * high
    high = min(high, most + 1)
    while high - low > 1 and high > CLOSE * low:
        middle = (low + high) // 2
        low, high = (middle, high) if held(middle) else (low, middle)
    return low


@dataclass(frozen=True)
class LoadResult:
    """Runs of one load with different numbers of vehicles, in the order of their numbers."""

    runs: Sequence[Run]

    @property
    def most_held(self) -> int:
        """The largest number that held, 0 if none did."""
        return max((run.load.vehicles for run in self.runs if run.verdict.held), default=0)

    def headline(self) -> str:
        """Return the result in a line."""
        load, row = self.runs[0].load, self.runs[0].row
        what = f"{load.mode}, {row.width}x{row.height}, {load.hz:g} Hz"
        if row.run is not None:
            times = sum(run.verdict.held for run in self.runs)
            return f"{_vehicles(load.vehicles)} held in {times} of {len(self.runs)} runs ({what})"
        if len(self.runs) > 1:
            return f"{_vehicles(self.most_held)} held ({what})"
        held = "held" if self.most_held else "not held"
        return f"{_vehicles(load.vehicles)} {held} ({what})"

    @cached_property
    def content(self) -> dict[str, Any]:
        """The content of ``result.json``."""
        link = self.runs[0].load.link
        rows = [run.row for run in self.runs]
        return make_result("loadtest", provenance([] if link is None else [link]), {"rows": rows})


def _vehicles(count: int) -> str:
    return "1 vehicle" if count == 1 else f"{count} vehicles"


def print_runs(console: Console, result: LoadResult) -> None:
    """Print a row for each run."""
    columns = ("vehicles", "held", "p50 ms", "p99 ms", "on time %", "server cores", "limit")
    rows = [
        [
            str(run.load.vehicles),
            "yes" if run.verdict.held else "no",
            f"{run.verdict.p50_ms:.1f}",
            f"{run.verdict.p99_ms:.1f}",
            f"{run.verdict.on_time_percent:.2f}",
            f"{run.row.server_cores:.2f}",
            run.verdict.limited_by,
        ]
        for run in result.runs
    ]
    text_table(columns, rows, result.headline()).print(console)


def write_load_result(result: LoadResult, out: Path) -> None:
    """Write ``result.json`` and ``report.html`` into ``out``."""
    write_result(out / "result.json", result.content)
    last, content = result.runs[-1], result.content
    deadline_ms = last.load.bounds.deadline_ms
    latency_ms = {_vehicles(run.load.vehicles): run.latency_ms for run in result.runs}
    write_page(
        out / "report.html",
        "loadtest/loadtest.html.j2",
        result.headline(),
        {key: content[key] for key in ("command", "revision", "dirty", "host")},
        what=_what(last.load),
        rows=content["rows"],
        deadline_ms=deadline_ms,
        latency_svg=latency_chart(latency_ms, deadline_ms),
    )


WORK = {
    Mode.TRANSPORT: "The server parses, checks, queues, acknowledges and counts; it neither "
    "renders nor decodes.",
    Mode.RECEIVER: "The server decodes against cached renders: each pose is rendered once.",
    Mode.FULL: "The server renders and decodes every frame, as always.",
}


def _what(load: Load) -> str:
    link = f"a link of its own ({load.link.stem})" if load.link else "loopback"
    vehicles = (
        "Prerecorded vehicles replay packets that were coded before; of a vehicle's own time the "
        f"latency contains {load.vehicle_ms:g} ms"
        if load.kind is Vehicles.PRERECORDED
        else "Live vehicles render and encode on this machine"
    )
    return (
        f"{WORK[load.mode]} {vehicles}. Cameras a vehicle: {load.cameras}; each vehicle over "
        f"{link}; {load.duration_s:g} s counted after {load.warm_up_s:g} s of warm-up."
    )


def latency_chart(latency_ms: Mapping[str, Sequence[float]], deadline_ms: float) -> str:
    """Return the share of acknowledged frames over their latency as SVG, a curve for each run."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        colours = mpl.colormaps["viridis"](np.linspace(0.1, 0.85, max(1, len(latency_ms))))
        for (name, values), colour in zip(latency_ms.items(), colours, strict=True):
            ordered = np.sort(np.array(values))
            share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
            axes.plot(ordered, share, color=colour, linewidth=2, label=name)
        axes.axvline(deadline_ms, color=RENDER, linewidth=1.5, linestyle="--")
        axes.annotate(
            "deadline",
            (deadline_ms, 4),
            xytext=(5, 0),
            textcoords="offset points",
            color=RENDER,
        )
        axes.set(xlabel="ms from due to acknowledged", ylabel="% of frames", xscale="log")
        axes.set_ylim(bottom=0)
        for set_formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            set_formatter(mpl.ticker.FormatStrFormatter("%g"))
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        return svg(figure)
