"""Runs of a load test, a search for the limit, and their result.

A run is a server, links and vehicles as processes. The result is a JSON file, a page with a figure
of the latencies, and a table on the terminal.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from rich.console import Console

from rfcore.codec.h264.config import DEFAULT_EFFORT, CoderSettings
from rfcore.field import load_field
from rfcore.program import working
from rfcore.raster.renderers import CPU
from rfedge.loadtest.drive import (
    RunMeasurements,
    Usage,
    drive_live,
    drive_prerecorded,
    links_busy,
    measured,
)
from rfedge.loadtest.plan import SETTLING_S, Load, Mode, Vehicles, Verdict, judge
from rfedge.loadtest.prerecorded import PrerecordedDrive, payload_drive, prerecorded_drive
from rfedge.processes import Service, command_of, service
from rfedge.report.charts import RENDER, STYLE, new_axes, svg
from rfedge.report.page import write_page
from rfedge.report.tables import text_table
from rfedge.results import make_result, provenance, write_result


@dataclass(frozen=True)
class TestBed:
    """The field, the drive and the folders of load tests."""

    field: Path
    """The field's archive, which is alone in its folder."""
    drive: Path
    """The drive whose pictures the vehicles send."""
    workers: int
    """Frames that the server reconstructs at once."""
    cache: Path
    """Folder that keeps prerecorded drives."""
    work: Path
    """Folder for the logs of the processes."""
    effort: str = DEFAULT_EFFORT
    crf: float = 23.0

    __test__ = False


@dataclass(frozen=True)
class LoadRow:
    """One load and its measurements; latencies are None when nothing was acknowledged.

    ``*_cores`` are CPU seconds per second; ``server_loop_cores`` those of the server's event loop.
    """

    mode: str
    vehicles: int
    hz: float
    width: int
    height: int
    held: bool
    p50_ms: float | None
    p99_ms: float | None
    on_time_percent: float
    on_time_at_least_percent: float
    """Lower end of the share's 95 % interval."""
    fairness: float | None
    """Share on time of the worst vehicle over that of the best; None: nothing to compare."""
    limited_by: str
    broken: Sequence[str]
    """The bounds that were not kept."""
    kind: str
    """``prerecorded`` or ``live`` vehicles."""
    cameras: int
    payload_bytes: float
    """Mean payload of a frame."""
    link: str | None
    """Name of the link profile; None: loopback."""
    duration_s: float
    vehicle_ms: float
    admission: bool
    refused: int
    failed: int
    reduced: int
    """Vehicles that were granted less than they asked for."""
    nacked: int
    server_cores: float
    server_loop_cores: float
    vehicles_cores: float
    links_cores: float
    others_cores: float
    server_growth_mb: float | None
    """Growth of the server's memory after it has settled; None if the run ended before."""
    generator_lag_ms: float
    """99th percentile of how late the generator's event loop was."""
    renderer: str = CPU
    threads: int = 1
    """Threads of a render."""
    run: int | None = None
    """Number of the run, from 1, where a load is repeated."""
    due: int | None = None
    """Pictures that were due; None in older results."""
    answered: int | None = None
    """Pictures that were acknowledged, of which the percentiles are; None in older results."""


@dataclass(frozen=True)
class Run:
    """One load, its verdict and its row of the result; latencies of all acknowledged frames."""

    load: Load
    verdict: Verdict
    row: LoadRow
    latency_ms: Sequence[float]
    payload_bytes: Sequence[int]
    usage: Mapping[str, Usage]


def run_load(load: Load, bed: TestBed) -> Run:
    """Run one load to its end; raise ``RfedgeError`` naming the process that failed."""
    folder = recorded(load, bed)
    drive = PrerecordedDrive.read(folder)
    bed.work.mkdir(parents=True, exist_ok=True)
    with ExitStack() as processes:
        server = processes.enter_context(_server(load, bed))
        addresses = [server.address] * load.vehicles
        pids = {"server": server.process.pid}
        if load.link is not None:
            links = processes.enter_context(_links(load, load.link, server, bed.work))
            addresses = links.address.split("\n")
            pids["links"] = links.process.pid
        if load.kind is Vehicles.LIVE:
            measurements = drive_live(load, addresses, pids, bed.work, _agent(load, bed))
        else:
            measurements = drive_prerecorded(load, addresses, pids, bed.work, folder)
    busy = links_busy(bed.work / "links.jsonl", load) if load.link is not None else 0.0
    found = measured(load, measurements, busy, _workers(load, bed))
    verdict = judge(found, load.bounds)
    row = _row(load, drive, measurements, verdict, found.growth_mb)
    latency_ms = [ms for vehicle in found.vehicles for ms in vehicle.latency_ms]
    payload_bytes = [len(frame.packet.payload) for frame in drive.chain]
    return Run(load, verdict, row, latency_ms, payload_bytes, measurements.usage)


def recorded(load: Load, bed: TestBed) -> Path:
    """Return the folder of the drive that the vehicles send, coded now if it is new."""
    field = load_field(bed.field)
    if load.mode is not Mode.TRANSPORT:
        return prerecorded_drive(bed.drive, field, bed.cache, bed.effort, bed.crf)
    folder = bed.cache / f"payload-{load.payload_bytes}"
    payload_drive(field.field_id, load.payload_bytes).write(folder)
    return folder


def _server(load: Load, bed: TestBed) -> Any:
    fields, workers = str(bed.field.parent), str(_workers(load, bed))
    if load.mode is Mode.FULL:
        command = [*command_of("mec-server"), "--fields", fields, "--workers", workers]
        limits = () if load.admission else ("--max-load", "0")
        command += [*_render(load), "--listen", "127.0.0.1:0", *limits]
        return service("mec-server", command, bed.work)
    module = [sys.executable, "-m", "rfedge.loadtest.server"]
    return service("mec-server", [*module, load.mode, fields, workers], bed.work)


def _workers(load: Load, bed: TestBed) -> int:
    """Return the number of workers; one in transport mode.

    With nothing to compute, more workers only compete for Python's lock: the 99th percentile of
    100 vehicles at 30 Hz was 86 and 41 ms with two, 31 and 15 ms with one.
    """
    return 1 if load.mode is Mode.TRANSPORT else bed.workers


def _links(load: Load, profile: Path, server: Service, work: Path) -> Any:
    module = [sys.executable, "-m", "rfedge.link.proxy", str(profile), str(load.vehicles)]
    return service("links", [*module, server.address, str(work / "links.jsonl")], work)


def _agent(load: Load, bed: TestBed) -> Sequence[str]:
    return [
        *command_of("cav-agent"),
        *("--drive", str(bed.drive), "--fields", str(bed.field.parent)),
        *CoderSettings.of(bed.effort).arguments,
        *("--crf", str(bed.crf), "--loop", *_render(load)),
    ]


def _render(load: Load) -> Sequence[str]:
    return ["--threads", str(load.render.threads), "--renderer", load.render.renderer]


def _row(
    load: Load,
    drive: PrerecordedDrive,
    measurements: RunMeasurements,
    verdict: Verdict,
    growth_mb: float | None,
) -> LoadRow:
    k = drive.intrinsics
    return LoadRow(
        mode=str(load.mode),
        vehicles=load.vehicles,
        hz=load.hz,
        width=k.width_px,
        height=k.height_px,
        held=verdict.held,
        p50_ms=_finite(verdict.p50_ms),
        p99_ms=_finite(verdict.p99_ms),
        due=verdict.due,
        answered=verdict.answered,
        on_time_percent=verdict.on_time_percent,
        on_time_at_least_percent=verdict.on_time_at_least_percent,
        fairness=verdict.fairness,
        limited_by=verdict.limited_by,
        broken=verdict.broken,
        kind=str(load.kind),
        cameras=load.cameras,
        payload_bytes=drive.mean_payload_bytes,
        link=None if load.link is None else load.link.stem,
        duration_s=load.duration_s,
        vehicle_ms=load.vehicle_ms,
        admission=load.admission,
        renderer=load.render.renderer,
        threads=load.render.threads,
        server_growth_mb=growth_mb,
        **measurements.fields(),
    )


def _finite(ms: float) -> float | None:
    """Return None for the percentile of an empty list, which is infinite."""
    return ms if math.isfinite(ms) else None


CLOSE = 1.1
"""The search stops at this ratio of its bounds: short runs on a noisy machine repeat no closer."""


def run_loads(
    load: Load, bed: TestBed, console: Console, *, find_limit: bool = False, repeated: int = 1
) -> LoadResult:
    """Run a load ``repeated`` times, or search for the largest number of vehicles that is held."""
    runs: list[Run] = []

    def held(vehicles: int) -> bool:
        console.print(f"[bold]{_vehicles(vehicles)}[/], {load.mode}, {load.hz:g} Hz")
        times = f"{load.warm_up_s:g} s of warm-up, {load.duration_s:g} s counted"
        with working(f"starting them, {times}"):
            runs.append(run_load(replace(load, vehicles=vehicles), bed))
        console.print(f"  {_outcome(runs[-1])}")
        if runs[-1].row.server_growth_mb is None:
            console.print(f"  memory is not judged: it settles for {SETTLING_S:g} s first")
        return runs[-1].verdict.held

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


def _outcome(run: Run) -> str:
    """Return in a line whether a load was held, what became of its vehicles, and the limit."""
    verdict, row = run.verdict, run.row
    counts = ((row.refused, "refused"), (row.failed, "failed"), (row.reduced, "at a lower rate"))
    ended = [f"{_vehicles(count)} {what}" for count, what in counts if count]
    parts = [*verdict.broken, *ended, f"limit: {verdict.limited_by}"]
    return ("held; " if verdict.held else "not held: ") + "; ".join(parts)


def print_runs(console: Console, result: LoadResult) -> None:
    """Print a row for each run, and why the smallest load that was not held was not."""
    columns = ("vehicles", "held", "answered", "p50 ms", "p99 ms", "on time %", "server cores")
    rows = [
        [
            str(run.load.vehicles),
            "yes" if run.verdict.held else "no",
            f"{run.verdict.answered} of {run.verdict.due}",
            f"{run.verdict.p50_ms:.1f}",
            f"{run.verdict.p99_ms:.1f}",
            f"{run.verdict.on_time_percent:.2f}",
            f"{run.row.server_cores:.2f}",
        ]
        for run in result.runs
    ]
    text_table(columns, rows, result.headline()).print(console)
    run = next((run for run in result.runs if not run.verdict.held), result.runs[-1])
    console.print(f"{_vehicles(run.load.vehicles)} {_outcome(run)}", highlight=False)


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
        latency_svg=latency_chart(latency_ms, deadline_ms, _conditions(last.load)),
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


def _conditions(load: Load) -> str:
    cameras = "1 camera" if load.cameras == 1 else f"{load.cameras} cameras"
    link = load.link.stem if load.link else "loopback"
    return f"{cameras} a vehicle at {load.hz:g} Hz, {load.mode}, {link}"


def latency_chart(latency_ms: Mapping[str, Sequence[float]], deadline_ms: float, title: str) -> str:
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
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_minor_locator(mpl.ticker.NullLocator())
        axes.xaxis.set_major_formatter(mpl.ticker.FormatStrFormatter("%g"))
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1), fontsize=9)
        return svg(figure)
