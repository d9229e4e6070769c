"""The result of a load test: JSON, report, figure, table, and its section of the results page.

``record`` collects rows of several runs in one file, each with its own command and revision.

``Command`` is what ``rfedge loadtest`` runs: one load, or a search for the limit; then files and a
table.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.console import Console

from rfcore.files import write_whole
from rfedge.loadtest.plan import Load, Mode, Vehicles
from rfedge.loadtest.run import LoadRow, Run, TestBed, run_load
from rfedge.loadtest.uplink import MOST, RATES_MBPS, Traffic, largest_held, vehicles_carried
from rfedge.report.charts import GRID, INK, MUTED, PAYLOAD, RENDER, STYLE, new_axes, svg
from rfedge.report.tables import cell, heading, print_table, table
from rfedge.results import (
    Result,
    make_result,
    provenance,
    read_result,
    rows_of,
    write_result,
)

__all__ = [
    "Command",
    "LimitRow",
    "LoadResult",
    "latency_chart",
    "load_section",
    "print_runs",
    "ratio_section",
    "record",
    "uplink_chart",
    "write_load_result",
]


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


def latency_chart(latency_ms: Mapping[str, Sequence[float]], deadline_ms: float) -> str:
    """Return the share of acknowledged frames over their latency, a curve for each run."""
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


def uplink_chart(
    carried: Sequence[tuple[float, int]], server_vehicles: int | None, most: int
) -> str:
    """Return vehicles over the uplink they share (Mbit/s), and what the server carried."""
    with mpl.rc_context(STYLE):
        figure, axes = new_axes()
        rates, vehicles = zip(*carried, strict=True)
        axes.plot(rates, vehicles, color=PAYLOAD, linewidth=2, marker="o", markersize=4)
        for rate, count in carried:
            label = f"{count}+" if count >= most else str(count)
            axes.annotate(
                label,
                (rate, count),
                xytext=(0, 7),
                textcoords="offset points",
                ha="center",
                color=INK,
            )
        if server_vehicles:
            axes.axhline(server_vehicles, color=RENDER, linewidth=1.5, linestyle="--")
            axes.annotate(
                f"held by the server in this test: {server_vehicles}",
                (rates[-1], server_vehicles),
                xytext=(0, -12),
                textcoords="offset points",
                ha="right",
                color=RENDER,
            )
        axes.set(xlabel="throughput of the shared uplink, Mbit/s", ylabel="vehicles", xscale="log")
        axes.set_xticks(rates, [f"{rate:g}" for rate in rates])
        axes.minorticks_off()
        axes.yaxis.get_major_locator().set_params(integer=True)
        axes.tick_params(colors=MUTED)
        axes.spines["bottom"].set_color(GRID)
        axes.margins(y=0.15)
        return svg(figure)


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
        inputs = [] if self.runs[0].load.link is None else [self.runs[0].load.link]
        rows = [run.row for run in self.runs]
        return make_result("loadtest", provenance(inputs), {"rows": rows})


def print_runs(console: Console, result: LoadResult) -> None:
    """Print a row for each run."""
    columns = ("vehicles", "held", "p50 ms", "p99 ms", "on time %", "server cores", "limit")
    print_table(console, result.headline(), columns, [_printed(run) for run in result.runs])


def _printed(run: Run) -> list[str]:
    verdict = run.verdict
    return [
        str(run.load.vehicles),
        "yes" if verdict.held else "no",
        f"{verdict.p50_ms:.1f}",
        f"{verdict.p99_ms:.1f}",
        f"{verdict.on_time_percent:.2f}",
        f"{run.row.server_cores:.2f}",
        verdict.limited_by,
    ]


def write_load_result(result: LoadResult, out: Path) -> None:
    """Write ``result.json``, ``report.html`` and ``vehicles_vs_uplink.svg`` into ``out``."""
    write_result(out / "result.json", result.content)
    figure = _uplink(result)
    write_whole(out / "vehicles_vs_uplink.svg", figure + "\n")
    write_whole(out / "report.html", _page(result, figure))


def record(path: Path, result: LoadResult) -> None:
    """Put the rows of a result into the file at ``path``, in place of those of the same loads.

    Each row keeps the command and revision it was made by. Raises ``InvalidInput`` for a file that
    holds no load test.
    """
    content = result.content
    made = {key: content[key] for key in ("command", "revision")}
    new = [replace(run.row, **made) for run in result.runs]
    old = rows_of(LoadRow, read_result(path, "loadtest")["rows"]) if path.exists() else []
    replaced = {_key(row) for row in new}
    rows = sorted([row for row in old if _key(row) not in replaced] + new, key=_order)
    whole = make_result("loadtest", provenance(command="rfedge loadtest"), {"rows": rows})
    write_result(path, whole)


def _key(row: LoadRow) -> tuple[Any, ...]:
    return tuple(getattr(row, name) for name in KEY)


def _order(row: LoadRow) -> tuple[int, str, float, int, int]:
    return list(Mode).index(Mode(row.mode)), row.kind, row.hz, row.vehicles, row.run or 0


def _vehicles(count: int) -> str:
    return "1 vehicle" if count == 1 else f"{count} vehicles"


def _uplink(result: LoadResult) -> str:
    run = result.runs[-1]
    sizes = [size for size in run.payload_bytes for _ in range(run.load.cameras)]
    budget_s = run.load.bounds.deadline_ms / 2e3
    traffic = Traffic(sizes, run.load.hz * run.load.cameras, budget_s)
    carried = [(rate, vehicles_carried(traffic, 1e6 * rate)) for rate in RATES_MBPS]
    return uplink_chart(carried, result.most_held or None, MOST)


def _page(result: LoadResult, figure: str) -> str:
    environment = Environment(
        loader=PackageLoader("rfedge.loadtest", "."), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["ms"] = lambda value: "-" if value is None else f"{value:.1f}"
    last, content = result.runs[-1], result.content
    latency_ms = {_vehicles(run.load.vehicles): run.latency_ms for run in result.runs}
    return environment.get_template("loadtest.html.j2").render(
        headline=result.headline(),
        what=_what(last),
        rows=content["rows"],
        deadline_ms=last.load.bounds.deadline_ms,
        latency_svg=latency_chart(latency_ms, last.load.bounds.deadline_ms),
        uplink_svg=figure,
        payload_bytes=last.row.payload_bytes,
        hz=last.load.hz,
        budget_ms=last.load.bounds.deadline_ms / 2,
        provenance=json.dumps(
            {key: content[key] for key in ("command", "revision", "dirty", "host")}, indent=2
        ),
    )


def _what(run: Run) -> str:
    load = run.load
    does = {
        "transport": "The server parses, checks, queues, acknowledges and counts; it neither "
        "renders nor decodes.",
        "receiver": "The server decodes against cached renders: each pose is rendered once.",
        "full": "The server renders and decodes every frame, as always.",
    }[load.mode]
    link = f"a link of its own ({load.link.stem})" if load.link else "loopback"
    vehicles = (
        "Prerecorded vehicles replay packets that were coded before; of a vehicle's own time the "
        f"latency contains {load.vehicle_ms:g} ms"
        if load.kind is Vehicles.PRERECORDED
        else "Live vehicles render and encode on this machine"
    )
    return (
        f"{does} {vehicles}. Cameras a vehicle: {load.cameras}; each vehicle over {link}; "
        f"{load.duration_s:g} s counted after {load.warm_up_s:g} s of warm-up."
    )


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


def load_section(path: Path, result: Result) -> str:
    """Return a table of the runs, with what was not kept and the commands below it."""
    rows = rows_of(LoadRow, result["rows"])
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


def _note(row: LoadRow) -> str:
    broken = f" Not kept: {'; '.join(row.broken)}." if row.broken else ""
    size = f"{row.width}x{row.height}, {row.payload_bytes:.0f} bytes of payload a frame"
    return f"* `{row.command}` at `{row.revision}` ({row.kind} vehicles, {size}).{broken}"
