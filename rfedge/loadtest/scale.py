"""The cases of several servers behind Envoy, what it adds to the time of a frame, and a plan.

All vehicles are ``cav-agent`` processes; what became of their pictures is read from their reports.
Times are of one clock (Unix time): a picture's Ack is its capture plus its latency.
"""

from __future__ import annotations

import json
import math
import shutil
import signal
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import grpc
from rich.console import Console

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.conventions import CONSUMER_OPTIONS
from rfcore.wire.publish import Ground, publish
from rfcore.wire.tiles import Area
from rfcore.wire.twin import (
    PictureEncoding,
    Subscription,
    TwinPicture,
    subscription_to_wire,
    twin_message_from_wire,
)
from rfcore.wire.v1 import twin_pb2_grpc
from rfedge.datasets.convert import convert_dataset
from rfedge.demo.processes import command_of
from rfedge.loadtest.cases import Measured, ScaleRecord, ScaleRow, print_scale
from rfedge.loadtest.envoy import (
    PROXIED,
    Envoy,
    EnvoySetup,
    ServerGroup,
    envoy_binary,
)
from rfedge.loadtest.planning import PlannedLoad, PlannedRow, compare_with_plan
from rfedge.loadtest.run import TestBed
from rfedge.results import provenance
from rfedge.samples import sample_path

__all__ = [
    "Case",
    "Fleet",
    "ScaleJob",
    "city_case",
    "failures",
    "keyframes",
    "p99",
    "planned_load",
    "resumed_s",
    "run_scale",
]

MOST_OVER_MEAN = 1.5
RESUME_S = 1.0
RESTART_S = 3.0
ADDED_MS = 3.0
PLANNED_PERCENT, PLANNED_AGE_PERCENT = 15.0, 25.0
CITY_S = 600.0
PAIR_HZ = 10.0
WATCH_S = 2.0
WAIT_S = 120.0
POLL_S = 0.05
EVERYWHERE = Ground(Area((-1e4, -1e4), (1e4, 1e4)), 0.0)

Lines = Sequence[Mapping[str, Any]]
"""A vehicle's report: a line a picture (``cav_agent.frame_log``), in the order they ended."""


Case = Callable[["ScaleJob"], Measured]
"""Runs further processes, and returns what was measured."""


@dataclass(frozen=True)
class ScaleJob:
    """What ``EvalScale`` asks for."""

    vehicles: int
    servers: int
    rounds: int
    hz: float
    size_px: tuple[int, int] | None
    pairs: int
    seconds: float
    field: Path
    drive: Path
    config: Path
    work: Path
    out: Path
    planned: tuple[int, ...] = ()
    """Numbers of prerecorded vehicles whose load is compared with its plan."""
    planned_hz: float = 3.0
    planned_warm_up_s: float = 5.0
    planned_runs: int = 3
    envoy: bool = True
    """Whether the cases behind Envoy are run."""
    moves: bool = True
    """Whether servers are killed, drained and added behind it."""
    also: tuple[Case, ...] = ()
    """Further cases."""
    add: bool = False
    """Whether rows of other cases that ``out`` holds are kept."""

    def __post_init__(self) -> None:
        behind_envoy = self.envoy and (self.moves or self.pairs)
        if not (behind_envoy or self.planned or self.also):
            raise InvalidInput("envoy", "nothing is to be measured; give --planned numbers")
        for name, value, low, high in (
            ("vehicles", self.vehicles, 2, 200),
            ("servers", self.servers, 2, 20),
            ("rounds", self.rounds, 1, 100),
            ("pairs", self.pairs, 0, 100),
        ):
            if not low <= value <= high:
                raise InvalidInput(name, f"{value} is outside {low}..{high}")
        if not self.seconds > 0:
            raise InvalidInput("seconds", f"{self.seconds:g} must be above 0 s")

    @property
    def reduced(self) -> Path:
        """The drive in the size that is sent."""
        return self.work / "drive"

    @property
    def published(self) -> Path:
        """The folder that the servers publish."""
        return self.work / "published"


def run_scale(job: ScaleJob, console: Console) -> None:
    """Measure, print, write; raise ``RfedgeError`` naming the cases that were not held.

    The file is written after every group of cases: a run that breaks off keeps what was measured.
    """
    made = provenance([job.field])
    record = ScaleRecord.read(job.out, made) if job.add else ScaleRecord()
    shutil.rmtree(job.work, ignore_errors=True)
    job.published.mkdir(parents=True)
    convert_dataset(job.drive, job.reduced, job.size_px)
    publish(job.published, "street", job.field, EVERYWHERE, datetime.now(UTC))
    rows: list[ScaleRow] = []
    for measured in _groups(job):
        rows += measured.rows
        record = record.plus(made, measured)
        record.write(job.out, made)
    print_scale(console, rows)
    broken = [row.case for row in rows if not row.held]
    if broken:
        raise RfedgeError("not held: " + "; ".join(broken))


def _groups(job: ScaleJob) -> Iterator[Measured]:
    """Run one group of cases after another."""
    if job.envoy and job.moves:
        yield Measured(moves(job))
    if job.envoy and job.pairs:
        yield _added_by_envoy(job)
    if job.planned:
        plans = compare_with_plan(planned_load(job))
        yield Measured([_planned_row(plan) for plan in plans], planning=plans)
    for case in job.also:
        yield case(job)


def city_case(city: Path) -> Case:
    """Return the case of a city that ``rfedge size --city`` plans: how long that takes."""
    return partial(_city_rows, city)


def _city_rows(city: Path, job: ScaleJob) -> Measured:
    out = job.work / "city"
    command = [*command_of("rfedge"), "size", "--city", str(city), "--out", str(out)]
    begin_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    took_s = time.monotonic() - begin_s
    if done.returncode != 0:
        raise RfedgeError(f"{city} was not planned: {done.stderr[-500:]}")
    return Measured([ScaleRow.at_most(f"{city.stem} planned, s", CITY_S, took_s)])


def planned_load(job: ScaleJob) -> PlannedLoad:
    """Return the loads that are compared with their plan, on the drive in the size that is sent."""
    bed = TestBed(
        field=job.field,
        drive=job.reduced,
        workers=2,
        cache=job.work / "coded",
        work=job.work / "planned",
    )
    link = sample_path("links/steady.toml")
    return PlannedLoad(
        vehicles=job.planned,
        hz=job.planned_hz,
        seconds=job.seconds,
        link=link,
        bed=bed,
        warm_up_s=job.planned_warm_up_s,
        runs=job.planned_runs,
    )


def _planned_row(plan: PlannedRow) -> ScaleRow:
    bound = PLANNED_AGE_PERCENT if plan.figure.startswith("age") else PLANNED_PERCENT
    case = f"planned {plan.vehicles} vehicles: {plan.figure}, % off"
    return ScaleRow.at_most(case, bound, abs(plan.difference_percent))


def resumed_s(lines: Lines, since_ns: int) -> float | None:
    """Return seconds from ``since_ns`` to the first Ack on another stream than the one before.

    None for a vehicle that kept its stream. A stream has epochs of its own.
    """
    acked = [line for line in lines if line["result"] == "acked"]
    before = {line["epoch"] for line in acked if line["capture_time_ns"] < since_ns}
    after = (line for line in acked if line["capture_time_ns"] >= since_ns)
    first = next((line for line in after if line["epoch"] not in before), None)
    if first is None:
        return None
    return float(first["capture_time_ns"] - since_ns) / 1e9 + float(first["latency_ms"]) / 1e3


def failures(lines: Lines, since_ns: int, until_ns: int) -> int:
    """Return how many pictures that were captured in between were sent in vain."""
    return sum(
        line["result"] in ("lost", "nacked") and since_ns <= line["capture_time_ns"] < until_ns
        for line in lines
    )


def keyframes(lines: Lines) -> int:
    """Return how many acknowledged pictures were not predicted from the field's render."""
    return sum(line["result"] == "acked" and "render" not in line["references"] for line in lines)


def p99(values: Iterable[float]) -> float:
    """Return the 99th percentile by nearest rank; the largest of up to a hundred values.

    Raises ``InvalidInput`` without values.
    """
    ordered = sorted(values)
    if not ordered:
        raise InvalidInput("values", "a percentile of nothing")
    return ordered[math.ceil(0.99 * len(ordered)) - 1]


@dataclass
class Fleet:
    """Vehicles as processes, and their reports."""

    job: ScaleJob
    folder: Path
    reports: list[Path] = field(default_factory=list)

    def start(self, stack: ExitStack, address: str, vehicles: int, hz: float) -> None:
        """Start vehicles and wait until each has had two pictures acknowledged."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for number in range(len(self.reports), len(self.reports) + vehicles):
            report = self.folder / f"{number}.jsonl"
            self.reports.append(report)
            command = [
                *command_of("cav-agent"),
                *("--server", address, "--vehicle", f"cav-{number}", "--loop"),
                *("--drive", str(self.job.reduced), "--fields", str(self.folder / "fields")),
                *("--rate", f"{hz:g}", "--effort", "fast", "--report", str(report)),
            ]
            with (self.folder / f"{number}.log").open("wb") as log:
                process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
            stack.callback(process.wait)
            stack.callback(process.kill)
            if number == 0:  # it fetches the field that the others find
                self.until_acked(0)
        self.until_acked(0)

    def lines(self) -> list[Lines]:
        """Return every vehicle's report so far."""
        return [_read(report) for report in self.reports]

    def until_acked(self, since_ns: int) -> None:
        """Wait until each vehicle had two pictures acknowledged that it took after ``since_ns``."""
        deadline = time.monotonic() + WAIT_S
        waiting = list(self.reports)
        while waiting := [x for x in waiting if _acked_since(_read(x), since_ns) < 2]:
            if time.monotonic() > deadline:
                raise RfedgeError(f"{waiting[0]} tells of no pictures after {WAIT_S:g} s")
            time.sleep(POLL_S)


def _read(report: Path) -> Lines:
    if not report.exists():
        return []
    return [json.loads(line) for line in report.read_text().splitlines(True) if line[-1] == "\n"]


def _acked_since(lines: Lines, since_ns: int) -> int:
    return sum(x["result"] == "acked" and x["capture_time_ns"] >= since_ns for x in lines)


@dataclass
class Seen:
    """What was seen in all rounds."""

    over_mean: list[float] = field(default_factory=list)
    after_adding: list[float] = field(default_factory=list)
    resumed_s: list[float] = field(default_factory=list)
    restarted_s: list[float] = field(default_factory=list)
    drained_frames: int = 0
    shown_twice: int = 0


def moves(job: ScaleJob) -> list[ScaleRow]:
    """Kill, add and drain servers under the vehicles, then restart Envoy; return the rows."""
    setup = EnvoySetup(envoy_binary(), job.config, job.work / "envoy")
    seen = Seen()
    with ServerGroup(job.published, setup) as group, ExitStack() as stack:
        for _ in range(job.servers):
            group.start_server()
        envoy = group.start_envoy()
        fleet = Fleet(job, job.work / "fleet")
        fleet.start(stack, envoy.address, job.vehicles, job.hz)
        seen.over_mean.append(_settled(group, envoy, job))
        for _ in range(job.rounds):
            _kill_one(group, envoy, fleet, seen)
            _drain_one(group, envoy, fleet, seen)
        _restart_envoy(group, envoy, fleet, seen)
        keys = sum(keyframes(lines) for lines in fleet.lines())
    at_most = ScaleRow.at_most
    return [
        at_most("placement: most streams over the mean", MOST_OVER_MEAN, max(seen.over_mean)),
        at_most("a server killed: Ack from another, p99, s", RESUME_S, p99(seen.resumed_s)),
        at_most("a server drained: frames lost", 0, seen.drained_frames),
        at_most(
            "a server added: most over the mean once others moved",
            MOST_OVER_MEAN,
            max(seen.after_adding),
        ),
        at_most("Envoy restarted: Ack again, p99, s", RESTART_S, p99(seen.restarted_s)),
        at_most("moved: pictures without the render as reference", 0, keys),
        at_most("moved: vehicles that two servers show", 0, seen.shown_twice),
    ]


def _settled(group: ServerGroup, envoy: Envoy, job: ScaleJob) -> float:
    """Wait until the servers that are there have all streams; return the most over the mean."""
    there = set(group.addresses)
    placed = envoy.until(lambda seen: set(seen) == there and sum(seen.values()) == job.vehicles)
    return max(placed.values()) * len(placed) / job.vehicles


def _kill_one(group: ServerGroup, envoy: Envoy, fleet: Fleet, seen: Seen) -> None:
    killed = group.servers.pop(0)
    since_ns = time.time_ns()
    killed.process.kill()
    seen.over_mean.append(_settled(group, envoy, fleet.job))
    fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in fleet.lines()]
    seen.resumed_s += [s for s in took_s if s is not None]
    seen.shown_twice += _shown_twice(group.addresses)
    _add_one(group, envoy)


def _add_one(group: ServerGroup, envoy: Envoy) -> None:
    group.start_server()
    group.list_servers()
    there = set(group.addresses)
    envoy.until(lambda seen: set(seen) == there)


def _drain_one(group: ServerGroup, envoy: Envoy, fleet: Fleet, seen: Seen) -> None:
    """Drain the server that has been there for longest; its vehicles fill the one just added."""
    drained = group.servers.pop(0)
    since_ns = time.time_ns()
    drained.process.send_signal(signal.SIGTERM)
    if drained.process.wait(WAIT_S) != 0:
        raise RfedgeError(f"{drained.name} did not end well; see {group.setup.folder}")
    seen.after_adding.append(_settled(group, envoy, fleet.job))
    until_ns = time.time_ns()
    fleet.until_acked(until_ns)
    seen.drained_frames += sum(failures(lines, since_ns, until_ns) for lines in fleet.lines())
    seen.shown_twice += _shown_twice(group.addresses)
    _add_one(group, envoy)


def _restart_envoy(group: ServerGroup, envoy: Envoy, fleet: Fleet, seen: Seen) -> None:
    """End Envoy and start it again at its port, with the same servers."""
    setup = EnvoySetup(
        group.setup.binary,
        group.setup.config,
        group.setup.folder,
        int(envoy.address.rpartition(":")[2]),
    )
    group.setup = setup
    envoy.process.kill()
    envoy.process.wait()
    since_ns = time.time_ns()
    again = group.start_envoy()
    seen.over_mean.append(_settled(group, again, fleet.job))
    fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in fleet.lines()]
    seen.restarted_s += [s for s in took_s if s is not None]


def _shown_twice(addresses: Sequence[str]) -> int:
    """Return how many vehicles more than one server shows pictures of within two seconds."""
    since_ns = time.time_ns()
    with ThreadPoolExecutor(len(addresses)) as watchers:
        shown = list(watchers.map(lambda address: _shown(address, since_ns), addresses))
    return sum(len(vehicles) for vehicles in shown) - len(set[str]().union(*shown))


def _shown(address: str, since_ns: int) -> set[str]:
    """Return the vehicles of which a server shows pictures that were taken from ``since_ns`` on."""
    vehicles: set[str] = set()
    wanted = subscription_to_wire(Subscription(encoding=PictureEncoding.NONE))
    with grpc.insecure_channel(address, CONSUMER_OPTIONS) as channel:
        watching = twin_pb2_grpc.TwinServiceStub(channel).Watch(wanted, timeout=WATCH_S)
        try:
            for response in watching:
                message = twin_message_from_wire(response)
                if isinstance(message, TwinPicture) and message.capture_time_ns >= since_ns:
                    vehicles.add(message.vehicle_id)
        except grpc.RpcError as error:
            if error.code() is not grpc.StatusCode.DEADLINE_EXCEEDED:
                raise RfedgeError(f"{address} does not show its pictures: {error}") from error
    return vehicles


def _added_by_envoy(job: ScaleJob) -> Measured:
    """One vehicle, straight to a server and through Envoy in turn: the p99 of its link, compared.

    The link is a frame's time from sending to Ack without the server's own; the median of the
    pairs' differences is what Envoy adds.
    """
    setup = EnvoySetup(envoy_binary(), job.config, job.work / "one")
    differences_ms = []
    with ServerGroup(job.published, setup, PROXIED) as group:
        server = group.start_server()
        envoy = group.start_envoy()
        for pair in range(job.pairs):
            ways = {"straight": server.address, "envoy": envoy.address}
            order = sorted(ways, reverse=bool(pair % 2))
            p99_ms = {way: _link_p99_ms(job, ways[way], f"pair{pair}-{way}") for way in order}
            differences_ms.append(p99_ms["envoy"] - p99_ms["straight"])
    row = ScaleRow.at_most(
        "Envoy between: p99 of a frame's way, ms more", ADDED_MS, statistics.median(differences_ms)
    )
    return Measured([row], envoy_added_ms=differences_ms)


def _link_p99_ms(job: ScaleJob, address: str, name: str) -> float:
    fleet = Fleet(job, job.work / name)
    with ExitStack() as stack:
        fleet.start(stack, address, 1, PAIR_HZ)
        since_ns = time.time_ns() + 10**9
        time.sleep(1.0 + job.seconds)
    (lines,) = fleet.lines()
    counted = [x for x in lines if x["result"] == "acked" and x["capture_time_ns"] >= since_ns]
    if len(counted) < job.seconds * PAIR_HZ / 2:
        raise RfedgeError(f"{name}: {len(counted)} frames in {job.seconds:g} s are too few")
    return p99(line["stage_ms"]["link"] for line in counted)
