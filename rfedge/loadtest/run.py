"""One run of a load test: server, links and vehicles as processes."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.codec.h264.config import DEFAULT_EFFORT, CoderSettings
from rfcore.field import load_field
from rfcore.raster.renderers import CPU
from rfedge.loadtest.drive import (
    RunMeasurements,
    Usage,
    drive_live,
    drive_prerecorded,
    links_busy,
    measured,
)
from rfedge.loadtest.plan import Load, Mode, Vehicles, Verdict, judge
from rfedge.loadtest.prerecorded import PrerecordedDrive, payload_drive, prerecorded_drive
from rfedge.processes import Service, command_of, service

__all__ = ["LoadRow", "Run", "TestBed", "recorded", "run_load"]


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
    fairness: float
    """Share on time of the worst vehicle over that of the best."""
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
    server_growth_mb: float
    generator_lag_ms: float
    """99th percentile of how late the generator's event loop was."""
    renderer: str = CPU
    threads: int = 1
    """Threads of a render."""
    run: int | None = None
    """Number of the run, from 1, where a load is repeated."""


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
    row = _row(load, drive, measurements, verdict)
    latency_ms = [ms for vehicle in found.vehicles for ms in vehicle.latency_ms]
    payload_bytes = [len(frame.packet.payload) for frame in drive.chain]
    return Run(load, verdict, row, latency_ms, payload_bytes, measurements.usage)


def recorded(load: Load, bed: TestBed) -> Path:
    """Return the folder of the drive that the vehicles send, coded now if it is new."""
    field = load_field(bed.field)
    if load.mode is not Mode.TRANSPORT:
        return prerecorded_drive(bed.drive, field, bed.cache, bed.effort, bed.crf)
    folder = bed.cache / f"payload-{load.size_bytes}"
    payload_drive(field.field_id, load.size_bytes).write(folder)
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
    module = [sys.executable, "-m", "rfedge.loadtest.links", str(profile), str(load.vehicles)]
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
    load: Load, drive: PrerecordedDrive, measurements: RunMeasurements, verdict: Verdict
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
        **measurements.fields(),
    )


def _finite(ms: float) -> float | None:
    """Return None for the percentile of an empty list, which is infinite."""
    return ms if math.isfinite(ms) else None
