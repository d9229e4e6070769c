"""The twin with a browser: how old pictures are when shown, and what it costs the ingest."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from rfcore.field import load_field
from rfedge.demo.processes import Service, command_of, service
from rfedge.loadtest.drive import drive_prerecorded
from rfedge.loadtest.live.chromium import opened
from rfedge.loadtest.live.peers import agent, watching
from rfedge.loadtest.live.report import AgeRow, IngestRow
from rfedge.loadtest.plan import Load, Mode
from rfedge.loadtest.prerecorded import prerecorded_drive

__all__ = ["TwinBed", "measure_age", "measure_ingest"]

INGEST_VEHICLES = 4
MOST_CONSUMERS = 64
WARM_UP_S = 5.0


class TwinBed:
    """Field, drive and folder of what is measured here."""

    def __init__(self, field: Path, drive: Path, work: Path, hz: float, seconds: float) -> None:
        self.field, self.drive, self.work = field, drive, work
        self.hz, self.seconds = hz, seconds
        work.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def server(self) -> Iterator[Service]:
        """Run a server that refuses no consumer."""
        command = [*command_of("mec-server"), "--fields", str(self.field.parent)]
        command += ["--listen", "127.0.0.1:0", "--max-load", "0"]
        for option in ("--identity-consumers", "--max-consumers"):
            command += [option, str(MOST_CONSUMERS)]
        with service("mec-server", command, self.work) as running:
            yield running

    @contextmanager
    def twin(self, server: str) -> Iterator[str]:
        """Run the page of a server; yield its address."""
        command = [*command_of("rfedge"), "twin", server, "--http", "127.0.0.1:0"]
        command += ["--fields", str(self.work / "fields")]
        with service("twin", command, self.work) as running:
            yield running.address

    @contextmanager
    def vehicles(self, server: str, count: int) -> Iterator[None]:
        """Run agents that drive again and again."""
        arguments = ["--server", server, "--drive", str(self.drive), "--loop"]
        arguments += ["--fields", str(self.field.parent), "--effort", "fast"]
        arguments += ["--rate", str(self.hz)]
        with ExitStack() as stack:
            for number in range(1, count + 1):
                stack.enter_context(agent(f"cav-{number}", arguments, self.work))
            yield


def measure_age(bed: TwinBed, cameras: int) -> AgeRow:
    """Return how old the pictures of ``cameras`` vehicles are when a browser shows them."""
    with (
        bed.server() as server,
        bed.twin(server.address) as url,
        bed.vehicles(server.address, cameras),
        opened(url) as page,
    ):
        page.await_shown(cameras)
        time.sleep(WARM_UP_S)
        seen = page.watch(bed.seconds)
    median_ms, p99_ms = percentiles(seen.ages_ms)
    return AgeRow(
        cameras, bed.hz, bed.seconds, len(seen.ages_ms), median_ms, p99_ms, seen.drawing_ms
    )


def measure_ingest(bed: TwinBed, rounds: int, consumers: int) -> IngestRow:
    """Return the server's latency without and with consumers and a browser, in turn."""
    folder = prerecorded_drive(bed.drive, load_field(bed.field), bed.work / "cache")
    alone_ms: list[float] = []
    watched_ms: list[float] = []
    with bed.server() as server:
        for _ in range(rounds):
            alone_ms += _latencies_ms(bed, server, folder)
            with (
                bed.twin(server.address) as url,
                opened(url),
                watching(server.address, consumers),
            ):
                watched_ms += _latencies_ms(bed, server, folder)
    return IngestRow(
        INGEST_VEHICLES,
        bed.hz,
        rounds,
        consumers,
        len(alone_ms),
        len(watched_ms),
        *percentiles(alone_ms),
        *percentiles(watched_ms),
    )


def _latencies_ms(bed: TwinBed, server: Service, folder: Path) -> list[float]:
    load = Load(Mode.FULL, INGEST_VEHICLES, bed.hz, duration_s=bed.seconds, warm_up_s=WARM_UP_S)
    addresses = [server.address] * load.vehicles
    pids = {"server": server.process.pid}
    measured = drive_prerecorded(load, addresses, pids, bed.work, folder)
    return [ms for vehicle in measured.vehicles for ms in vehicle.latency_ms]


def percentiles(values_ms: Sequence[float]) -> tuple[float | None, float | None]:
    """Return median and 99th percentile; None of nothing."""
    if not values_ms:
        return None, None
    return float(np.percentile(values_ms, 50)), float(np.percentile(values_ms, 99))
