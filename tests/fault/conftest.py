"""Real processes, something done to them, and a scoreboard of what followed.

The street, its coded frames and the raw vehicle are those of ``tests/integration``. What is marked
``fault_core`` is also run at street size: the shipped field, 640x360 at 10 Hz, where a frame costs
a server what it does on a road; bystanders replay packets there that were coded beforehand, as a
vehicle renders and codes on a machine of its own. Time is part of what is tested here: bounds are
in seconds of this machine, so run it on one that is quiet (``make test-fault``; it writes
``lab/results/faults.json``, and ``lab/results/faults.md`` from it).
"""

import asyncio
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from attack.bystander import HZ as BYSTANDER_HZ
from cav_agent.pipeline import Pipeline
from fault.streets import SHIPPED, SMALL, ShippedStreet, shipped_street
from integration.conftest import (
    CodedStreet,
    Street,
    coded_small_street,
    raw_vehicle,
    small_street,
)
from lab.pages.suites import LinkCell
from machine import MEASURED_AGAIN
from mec_server.decoding.child import DECODER_NAME
from rfcore.codec.h264.config import CodecConfig
from rfcore.dataset import read_dataset
from rfcore.wire.messages import FrameAddress
from scoreboard import Figures, Scoreboard

__all__ = ["raw_vehicle"]

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT / "tests")}
RATE_HZ = 20
SHIPPED_HZ = 5.0
"""Rate of a vehicle that renders and codes 640x360 here, beside servers."""
CALM_S = 3.0
FAULT_S = 3.0
"""As long as the calm that it is compared with: a p99 of fewer pictures is the latest one."""
AS_MANY_AT_STREET_SIZE = 2
"""Pictures, 120 of them: the p99 of 60 is the latest one but for a trifle, and a shared machine has
one that is late every few seconds, at the control as well, though not in the same ones."""
ALLOWANCE_MS = 10.0
"""A tenth of the frame budget: the 99th of a few dozen latencies is the largest, and one late
wake-up of a shared machine shall not count as harm done by a neighbour."""

FEWER = 0.05
"""Share of frames that may be missing: three in 3 s at 20 Hz."""

BOARD = Scoreboard("faults", "make test-fault")


def pytest_addoption(parser: pytest.Parser) -> None:
    BOARD.options(parser)


def pytest_configure(config: pytest.Config) -> None:
    BOARD.open(config)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if metafunc.definition.get_closest_marker("fault_core") is not None:
        metafunc.parametrize("street", (SMALL, SHIPPED), indirect=True, scope="session")


@pytest.fixture(scope="session")
def street(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Street:
    root = tmp_path_factory.mktemp("street")
    if getattr(request, "param", SMALL) == SMALL:
        return small_street(root)
    return shipped_street(root)


@pytest.fixture(scope="session")
def coded(street: Street) -> CodedStreet:
    return street.coded if isinstance(street, ShippedStreet) else coded_small_street(street)


async def appears(condition: Callable[[], Any], within_s: float = 60.0) -> Any:
    """Return the first true value of ``condition``."""
    until_s = time.monotonic() + within_s
    while not (value := condition()):
        assert time.monotonic() < until_s, f"not within {within_s} s"
        await asyncio.sleep(0.005)
    return value


@pytest.fixture(name="appears")
def appears_fixture() -> Callable[..., Any]:
    return appears


@dataclass
class Program:
    """A process of ours and its log."""

    process: subprocess.Popen[bytes]
    log: Path

    def entries(self, event: str) -> list[dict[str, Any]]:
        """Return the log lines of ``event``."""
        lines = [line for line in self.log.read_text().splitlines() if line.startswith("{")]
        return [entry for entry in map(json.loads, lines) if entry.get("event") == event]

    def send(self, number: signal.Signals) -> float:
        """Send a signal; return when."""
        self.process.send_signal(number)
        return time.time()

    def rss_bytes(self, name: str = "VmRSS") -> int:
        """Return resident memory; ``VmHWM`` is the most it ever was."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return 1024 * int(re.search(rf"{name}:\s+(\d+) kB", status)[1])  # type: ignore[index]

    def descendants(self) -> list[int]:
        """Return the processes it started, and those they did."""
        found, left = [], [self.process.pid]
        while left:
            pid = left.pop()
            for children in Path(f"/proc/{pid}/task").glob("*/children"):
                left += [int(child) for child in children.read_text().split()]
            found.append(pid)
        return found[1:]


@dataclass
class Server(Program):
    """``mec-server``."""

    address: str = ""

    def value(self, name: str, **labels: str) -> float:
        """Return a sample of its metrics, 0 where there is none."""
        port = self.entries("metrics")[-1]["port"]
        url = f"http://127.0.0.1:{port}/metrics"
        with urllib.request.urlopen(url, timeout=10) as answer:
            lines = answer.read().decode().splitlines()
        wanted = {f'{key}="{value}"' for key, value in labels.items()}
        for line in lines:
            metric, _, value = line.rpartition(" ")
            found, _, rest = metric.partition("{")
            if found == name and wanted <= set(rest.rstrip("}").split(",")):
                return float(value)
        return 0.0

    def decoders(self) -> list[int]:
        """Return its decoder processes, the one that stands ready included."""
        return [p for p in self.descendants() if _name(p) == DECODER_NAME]


@dataclass
class Vehicle(Program):
    """``cav-agent``."""

    report: Path = Path()

    def lines(self) -> list[dict[str, Any]]:
        """Return what is in its report, whole lines only."""
        if not self.report.exists():
            return []
        return [json.loads(line) for line in self.report.read_text().split("\n")[:-1]]

    def acked(self, after_s: float = 0.0) -> list[dict[str, Any]]:
        """Return the pictures that were acknowledged, and captured after a moment."""
        lines = self.lines()
        return [x for x in lines if x["result"] == "acked" and x["capture_time_ns"] / 1e9 > after_s]

    def acked_at_s(self, after_s: float) -> list[float]:
        """Return when pictures were acknowledged after a moment."""
        ends = [x["capture_time_ns"] / 1e9 + x["latency_ms"] / 1e3 for x in self.acked()]
        return sorted(end for end in ends if end > after_s)


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


class Site:
    """Starts servers and vehicles; ends them all."""

    def __init__(self, folder: Path, street: Any) -> None:
        self.street = street
        self._folder = folder
        self._numbers = itertools.count()
        self._programs: list[Program] = []

    async def server(
        self, *options: str, listen: str = "127.0.0.1:0", within: Sequence[str] = ()
    ) -> Server:
        """Return a server that accepts vehicles."""
        number = next(self._numbers)
        ready = self._folder / f"ready{number}"
        given = ("--listen", listen, "--ready-file", str(ready), "--metrics-port", "0")
        fields = () if "--fields" in options else ("--fields", str(self.street.store))
        process, log = self._start(within, "mec_server", *fields, *given, *options)
        server = Server(process, log)
        self._programs.append(server)
        await appears(lambda: ready.exists() or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        server.address = ready.read_text().strip()
        return server

    async def vehicle(
        self, address: str, name: str, *options: str, within: Sequence[str] = (), frames: int = 3
    ) -> Vehicle:
        """Return a vehicle that had so many frames acknowledged."""
        vehicle = self.start_vehicle(address, name, *options, within=within)
        await appears(lambda: len(vehicle.acked()) >= frames or vehicle.process.poll() is not None)
        assert vehicle.process.poll() is None, vehicle.log.read_text()
        return vehicle

    async def bystander(self, address: str, name: str = "bystander") -> Vehicle:
        """Return a vehicle that nothing is to happen to, which had some frames acknowledged."""
        if not isinstance(self.street, ShippedStreet):
            return await self.vehicle(address, name)
        report = self._folder / f"{name}.jsonl"
        words = ("vehicle", address, "", str(report), str(self.street.packets))
        process, log = self._start((), "attack.bystander", *words)
        bystander = Vehicle(process, log, report)
        self._programs.append(bystander)
        await appears(lambda: len(bystander.acked()) >= 3 or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        return bystander

    def start_vehicle(
        self, address: str, name: str, *options: str, within: Sequence[str] = ()
    ) -> Vehicle:
        """Return a vehicle that was only just started."""
        report = self._folder / f"{name}-{next(self._numbers)}.jsonl"
        given = {
            "--server": address,
            "--drive": self.street.drive,
            "--fields": self.street.store,
            "--vehicle": name,
            "--rate": SHIPPED_HZ if isinstance(self.street, ShippedStreet) else RATE_HZ,
            "--field": self.street.field_id,
            "--effort": "fast",
            "--report": report,
        }
        own = [name for name in options if name.startswith("--")]
        arguments = [str(x) for pair in given.items() if pair[0] not in own for x in pair]
        process, log = self._start(within, "cav_agent", *arguments, "--loop", *options)
        vehicle = Vehicle(process, log, report)
        self._programs.append(vehicle)
        return vehicle

    def _start(
        self, within: Sequence[str], module: str, *arguments: str
    ) -> tuple[subprocess.Popen[bytes], Path]:
        log = self._folder / f"{module}-{next(self._numbers)}.log"
        with log.open("wb") as file:
            command = [*within, sys.executable, "-m", module, *arguments]
            return subprocess.Popen(command, stderr=file, stdout=file, env=ENVIRONMENT), log

    def close(self) -> None:
        """Kill what is left."""
        for program in self._programs:
            program.process.kill()
        for program in self._programs:
            program.process.wait()


@pytest.fixture
def site(tmp_path: Path, street: Any) -> Iterator[Site]:
    made = Site(tmp_path, street)
    yield made
    made.close()


@dataclass
class Case(Figures):
    """One row of the scoreboard in the making."""

    street: Any
    control: Vehicle
    fault: str = ""
    injected_with: str = ""
    covers: str = ""
    cell: LinkCell | None = None
    _started_s: float = field(default_factory=time.time)
    _calm_until_s: float = 0.0
    _fault_until_s: float = 0.0

    def about(self, fault: str, injected_with: str, covers: str) -> None:
        """Say what is done, with what, and which of ``lab.pages.suites.KINDS`` it is."""
        size = f", {SHIPPED}" if isinstance(self.street, ShippedStreet) else ""
        self.fault, self.injected_with, self.covers = f"{fault}{size}", injected_with, covers

    def lasting(self, seconds: float) -> float:
        """Return how long that takes in which a bystander at street size takes
        ``AS_MANY_AT_STREET_SIZE`` times the pictures of one of ``RATE_HZ``."""
        if isinstance(self.street, ShippedStreet):
            return seconds * AS_MANY_AT_STREET_SIZE * RATE_HZ / BYSTANDER_HZ
        return seconds

    async def calm(self) -> None:
        """Let things run undisturbed for 3 s, at street size 12 s, to compare with."""
        self._started_s = time.time()
        await asyncio.sleep(self.lasting(CALM_S))
        self._calm_until_s = time.time()

    def over(self) -> None:
        """The fault is over; what follows is calm again."""
        self._fault_until_s = time.time()

    def at_most(self, what: str, value: float, limit: float, unit: str = "s") -> None:
        """Note a figure and its bound."""
        bound, is_timed = f"{what} <= {limit:g} {unit}", unit == "s"
        self.note(bound, f"{value:.3g} {unit}", value <= limit, is_timed=is_timed)

    def holds(self, what: str, value: object) -> None:
        """Note something that must be so."""
        self.note(what, "yes" if value else "no", bool(value))

    async def spares(self, bystander: Vehicle) -> None:
        """Note what the fault did to a vehicle that it was not meant for."""
        await asyncio.sleep(self.lasting(CALM_S / 2))
        lines = bystander.lines()
        disturbed = [x for x in lines if self._in_fault(x)]
        quiet = [
            x
            for x in lines
            if x["capture_time_ns"] / 1e9 > self._started_s and not self._in_fault(x)
        ]
        before, during = p99_ms(quiet), p99_ms(disturbed)
        elsewhere = p99_ms([x for x in self.control.lines() if self._in_fault(x)])
        limit = 1.2 * max(before, elsewhere) + ALLOWANCE_MS
        self.note(
            f"bystander's p99 <= 1.2 x the larger of calm and control + {ALLOWANCE_MS:g} ms",
            f"{before:.1f} -> {during:.1f} ms, control {elsewhere:.1f} ms",
            during <= limit,
            is_timed=True,
        )
        ended = {x["result"] for x in lines if x["capture_time_ns"] / 1e9 > self._started_s}
        self.holds("none of its frames lost or refused", ended <= {"acked", "dropped"})
        share, usual = delivered(disturbed), delivered(quiet)
        beside = delivered([x for x in self.control.lines() if self._in_fault(x)])
        self.note(
            f"delivered of its frames >= the smaller of calm and control - {FEWER:.0%}",
            f"{usual:.0%} -> {share:.0%}, control {beside:.0%}",
            share >= min(usual, beside) - FEWER,
        )
        self.holds("its pictures exact", all(map(is_exact, bystander.acked())))

    def recovers_exactly(self, vehicle: Vehicle, since_s: float) -> None:
        """Note that a new stream's first pictures are those of a run that begins there."""
        epoch = vehicle.acked(since_s)[0]["epoch"]
        lines = [x for x in vehicle.acked() if x["epoch"] == epoch][:6]
        got = [(x["sequence"], x["server_digest"]) for x in lines]
        fresh = fault_free(self.street, [x["index"] for x in lines])
        self.holds("frames after it byte-equal to a fault-free run", got == list(enumerate(fresh)))

    def row(self) -> dict[str, Any]:
        """Return the row of the scoreboard."""
        return {
            "fault": self.fault,
            "injected_with": self.injected_with,
            **self.texts(),
            "passed": self.held,
            "covers": self.covers,
            **({} if self.cell is None else {"cell": self.cell}),
        }

    def _in_fault(self, line: dict[str, Any]) -> bool:
        captured_s = line["capture_time_ns"] / 1e9
        return self._calm_until_s <= captured_s <= self._fault_until_s


def is_exact(line: dict[str, Any]) -> bool:
    """Tell whether the server's picture is the vehicle's."""
    if "exact" in line:
        return bool(line["exact"])
    return bool(line["server_digest"] == line["reconstruction_digest"])


def p99_ms(lines: Sequence[dict[str, Any]]) -> float:
    """Return the 99th percentile of the latencies of those that were answered."""
    latencies_ms = [x["latency_ms"] for x in lines if x["result"] == "acked"]
    assert latencies_ms, "the bystander was answered nothing"
    return float(np.percentile(latencies_ms, 99))


def delivered(lines: Sequence[dict[str, Any]]) -> float:
    """Return the share of captured pictures that were acknowledged."""
    return sum(x["result"] == "acked" for x in lines) / max(1, len(lines))


def fault_free(street: Any, indices: Sequence[int]) -> list[str]:
    """Return the digests of a stream that begins with these pictures of the drive."""
    pictures = read_dataset(street.drive, tile_origin=street.field.metadata.tile_origin).pictures
    k = pictures[0].camera.intrinsics
    config = CodecConfig(k.width_px, k.height_px, "fast")
    pipeline = Pipeline(street.field, config, time.perf_counter_ns)
    digests = []
    for sequence, index in enumerate(indices):
        picture = replace(pictures[index], camera=pictures[index].camera.rounded())
        base = FrameAddress("front", 0, sequence - 1) if sequence else None
        packet = pipeline.encode_picture(picture, 0, base)
        digests.append(packet.reconstruction_digest.hex())
    return digests


@pytest.fixture(scope="session")
def control(street: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Vehicle]:
    """A vehicle on a server of its own: what it suffers is the machine's doing."""
    site = Site(tmp_path_factory.mktemp("control"), street)

    async def start() -> Vehicle:
        server = await site.server()
        return await site.bystander(server.address, "control")

    yield asyncio.run(start())
    site.close()


@pytest.fixture
def case(request: pytest.FixtureRequest, street: Any, control: Vehicle) -> Iterator[Case]:
    made = Case(street, control)
    yield made
    BOARD.add(request.node.name, [made.row()])


@pytest.fixture
async def streaming(site: Site) -> tuple[Server, Vehicle]:
    """A server and a vehicle that nothing is to happen to."""
    server = await site.server()
    return server, await site.bystander(server.address)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    BOARD.leave_out(items, here, config.hook.pytest_deselected)
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.fault)
            item.add_marker(pytest.mark.slow)
            item.add_marker(MEASURED_AGAIN)


@pytest.fixture
def as_root() -> None:
    if os.geteuid() != 0:
        pytest.skip("network namespaces and mounts need root")
