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
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import grpc
from rich.console import Console

from lab.city.check import CheckRow, largest_differences
from lab.city.planned_load import PlannedLoad, PlannedRow, compare_with_plan
from lab.servers.cases import Measured, ScaleRecord, ScaleRow
from lab.servers.envoy import (
    PROXIED,
    Envoy,
    EnvoySetup,
    ServerGroup,
    envoy_binary,
)
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.publish import Ground, publish
from rfcore.wire.tiles import Area
from rfcore.wire.twin import PictureEncoding, Subscription, TwinPicture
from rfcore.wire.twin_client import TwinClient
from rfedge.datasets.convert import convert_dataset
from rfedge.loadtest.run import TestBed
from rfedge.processes import command_of
from rfedge.report.tables import Table, columns
from rfedge.results import provenance, read_result, rows_of
from rfedge.samples import sample_path

__all__ = [
    "Case",
    "Fleet",
    "ScaleJob",
    "Shown",
    "TwinWatch",
    "city_case",
    "failures",
    "keyframes",
    "p99",
    "planned_load",
    "resumed_s",
    "run_scale",
    "shown_twice",
]

MOST_OVER_MEAN = 1.5
RESUME_S = 1.0
RESTART_S = 3.0
ADDED_MS = 3.0
PLANNED_PERCENT, PLANNED_AGE_PERCENT = 15.0, 25.0
CITY_S = 600.0
PAIR_HZ = 10.0
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
    Table("Several servers", columns(ScaleRow), rows).print(console)
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
    """Return the case of a city that ``rfedge-lab city`` plans: how long that takes."""
    return partial(_city_rows, city)


def _city_rows(city: Path, job: ScaleJob) -> Measured:
    out = job.work / "city"
    command = [*command_of("rfedge"), "size", "--city", str(city), "--out", str(out)]
    begin_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    took_s = time.monotonic() - begin_s
    if done.returncode != 0:
        raise RfedgeError(f"{city} was not planned: {done.stderr[-500:]}")
    checks = rows_of(CheckRow, read_result(out / "city.json", "city")["checks"])
    at_most = ScaleRow.at_most
    return Measured(
        [
            at_most(f"{city.stem} planned, s", CITY_S, took_s),
            *(
                at_most(f"{city.stem}, flow against sessions: {figure}, % off", _bound(figure), off)
                for figure, _, off in largest_differences(checks)
            ),
        ]
    )


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
    case = f"planned {plan.vehicles} vehicles: {plan.figure}, % off"
    return ScaleRow.at_most(case, _bound(plan.figure), abs(plan.difference_percent))


def _bound(figure: str) -> float:
    """Return by how many percent a figure of a plan may be off."""
    return PLANNED_AGE_PERCENT if figure.startswith("age") else PLANNED_PERCENT


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
    left: list[Path] = field(default_factory=list)
    """Reports of vehicles that are gone."""

    def leave(self, vehicles: int) -> None:
        """Count only the first ``vehicles``; the others were ended."""
        self.left += self.reports[vehicles:]
        del self.reports[vehicles:]

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


@dataclass(frozen=True)
class Shown:
    """A picture that the twin of a server (HOST:PORT) showed."""

    vehicle_id: str
    camera_id: str
    capture_time_ns: int
    server: str


def shown_twice(pictures: Iterable[Shown]) -> int:
    """Return how many vehicles two servers showed at the same time.

    While a vehicle moves, both of its streams are open, and the old server shows what it took
    before: that is one vehicle. It is shown twice if two servers show one of its pictures, or if
    a server shows a picture that was taken after one that its successor has shown.
    """
    of_camera: dict[tuple[str, str], set[tuple[int, str]]] = {}
    for picture in pictures:
        camera = picture.vehicle_id, picture.camera_id
        of_camera.setdefault(camera, set()).add((picture.capture_time_ns, picture.server))
    return len({camera[0] for camera, shown in of_camera.items() if _are_mixed(sorted(shown))})


def _are_mixed(shown: Sequence[tuple[int, str]]) -> bool:
    """Return whether two servers have one moment, or the moments of a server another between."""
    moments = {moment for moment, _ in shown}
    stays = [server for server, _ in groupby(server for _, server in shown)]
    return len(moments) < len(shown) or len(set(stays)) < len(stays)


class TwinWatch:
    """Watches the twins of servers, in a thread each, until it is left.

    A server that ends or is killed has been watched to its end.
    """

    def __init__(self) -> None:
        self.pictures: list[Shown] = []
        self._problems: list[str] = []
        self._stack = ExitStack()

    def __enter__(self) -> TwinWatch:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, address: str) -> None:
        """Watch one more server from now on."""
        client = self._stack.enter_context(TwinClient(address))
        thread = threading.Thread(target=self._watch, args=(client,), daemon=True)
        thread.start()
        self._stack.callback(thread.join, WAIT_S)
        self._stack.callback(client.stop)

    def result(self) -> list[Shown]:
        """Return what was shown so far; raise ``RfedgeError`` for a server that showed nothing."""
        if self._problems:
            raise RfedgeError("; ".join(self._problems))
        return list(self.pictures)

    def _watch(self, client: TwinClient) -> None:
        address = str(client.address)
        try:
            for message in client.watch(Subscription(encoding=PictureEncoding.NONE)):
                if isinstance(message, TwinPicture):
                    shown = Shown(*message.key, message.capture_time_ns, address)
                    self.pictures.append(shown)
        except RfedgeError as error:
            call = error.__cause__
            if not (isinstance(call, grpc.Call) and call.code() is grpc.StatusCode.UNAVAILABLE):
                self._problems.append(f"{address} does not show its pictures: {error}")


@dataclass
class Seen:
    """What was seen in all rounds."""

    over_mean: list[float] = field(default_factory=list)
    after_adding: list[float] = field(default_factory=list)
    after_joining: list[float] = field(default_factory=list)
    resumed_s: list[float] = field(default_factory=list)
    restarted_s: list[float] = field(default_factory=list)
    drained_frames: int = 0


@dataclass(frozen=True)
class Site:
    """Servers behind Envoy, vehicles that stream to them, and who watches their twins."""

    group: ServerGroup
    envoy: Envoy
    fleet: Fleet
    watch: TwinWatch

    def settled(self) -> float:
        """Wait until the servers that are there have all streams; return the most over the mean."""
        there, vehicles = set(self.group.addresses), len(self.fleet.reports)
        placed = self.envoy.until(
            lambda seen: set(seen) == there and sum(seen.values()) == vehicles
        )
        return max(placed.values()) * len(placed) / vehicles

    def add_server(self) -> None:
        """Start one more, tell Envoy of it, and wait until it is healthy there."""
        self.watch.add(self.group.start_server().address)
        self.group.list_servers()
        there = set(self.group.addresses)
        self.envoy.until(lambda seen: set(seen) == there)


def moves(job: ScaleJob) -> list[ScaleRow]:
    """Kill, add and drain servers under the vehicles, then restart Envoy; return the rows."""
    setup = EnvoySetup(envoy_binary(), job.config, job.work / "envoy")
    seen = Seen()
    with ServerGroup(job.published, setup) as group, ExitStack() as stack, TwinWatch() as watch:
        for _ in range(job.servers):
            watch.add(group.start_server().address)
        fleet = Fleet(job, job.work / "fleet")
        site = Site(group, group.start_envoy(), fleet, watch)
        fleet.start(stack, site.envoy.address, job.vehicles, job.hz)
        seen.over_mean.append(site.settled())
        for _ in range(job.rounds):
            _kill_one(site, seen)
            _drain_one(site, seen)
        _let_others_join(site, seen)
        _restart_envoy(site, seen)
        keys = sum(keyframes(_read(report)) for report in (*fleet.reports, *fleet.left))
        twice = shown_twice(watch.result())
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
        at_most(
            "a server added: most over the mean once others joined",
            MOST_OVER_MEAN,
            max(seen.after_joining),
        ),
        at_most("Envoy restarted: Ack again, p99, s", RESTART_S, p99(seen.restarted_s)),
        at_most("moved: pictures without the render as reference", 0, keys),
        at_most("moved: vehicles that two servers show", 0, twice),
    ]


def _kill_one(site: Site, seen: Seen) -> None:
    killed = site.group.servers.pop(0)
    since_ns = time.time_ns()
    killed.process.kill()
    seen.over_mean.append(site.settled())
    site.fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in site.fleet.lines()]
    seen.resumed_s += [s for s in took_s if s is not None]
    site.add_server()


def _drain_one(site: Site, seen: Seen) -> None:
    """Drain the server that has been there for longest; its vehicles fill the one just added."""
    drained = site.group.servers.pop(0)
    since_ns = time.time_ns()
    drained.process.send_signal(signal.SIGTERM)
    if drained.process.wait(WAIT_S) != 0:
        raise RfedgeError(f"{drained.name} did not end well; see {site.group.setup.folder}")
    seen.after_adding.append(site.settled())
    until_ns = time.time_ns()
    site.fleet.until_acked(until_ns)
    seen.drained_frames += sum(failures(lines, since_ns, until_ns) for lines in site.fleet.lines())
    site.add_server()


def _let_others_join(site: Site, seen: Seen) -> None:
    """Start as many vehicles as an even share, and end them; the server just added has no stream.

    Envoy does not move streams that are open, so that only who comes later fills it.
    """
    job = site.fleet.job
    share = round(job.vehicles / len(site.group.servers))
    with ExitStack() as joined:
        site.fleet.start(joined, site.envoy.address, max(1, share), job.hz)
        seen.after_joining.append(site.settled())
    site.fleet.leave(job.vehicles)


def _restart_envoy(site: Site, seen: Seen) -> None:
    """End Envoy and start it again at its port, with the same servers."""
    group, port = site.group, int(site.envoy.address.rpartition(":")[2])
    group.setup = replace(group.setup, port=port)
    site.envoy.process.kill()
    site.envoy.process.wait()
    since_ns = time.time_ns()
    again = replace(site, envoy=group.start_envoy())
    seen.over_mean.append(again.settled())
    again.fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in again.fleet.lines()]
    seen.restarted_s += [s for s in took_s if s is not None]


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
