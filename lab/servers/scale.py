"""The cases of several servers behind Envoy, what Envoy adds to the time of a frame, and a plan.

All vehicles are ``cav-agent`` processes; what became of their pictures is read from their reports.
"""

from __future__ import annotations

import shutil
import signal
import statistics
import time
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from rich.console import Console

from lab.city.planned_load import PlannedLoad, compare_with_plan
from lab.servers import EvalScale
from lab.servers.cases import Case, Measured, ScaleRecord, ScaleRow
from lab.servers.envoy import PROXIED, Envoy, EnvoySetup, ServerGroup, envoy_binary
from lab.servers.fleet import (
    WAIT_S,
    Fleet,
    TwinWatch,
    failures,
    keyframes,
    p99,
    read_lines,
    resumed_s,
    shown_twice,
)
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.wire.tile_manifest import Ground, publish
from rfcore.wire.tiles import Area
from rfedge.arguments import parse_size
from rfedge.datasets.convert import convert_dataset
from rfedge.loadtest.run import TestBed
from rfedge.report.tables import Table, columns
from rfedge.results import provenance
from rfedge.samples import sample_path

MOST_OVER_MEAN = 1.5
RESUME_S = 1.0
RESTART_S = 3.0
ADDED_MS = 3.0
PLANNED_PERCENT, PLANNED_AGE_PERCENT = 15.0, 25.0
PAIR_HZ = 10.0
EVERYWHERE = Ground(Area((-1e4, -1e4), (1e4, 1e4)), 0.0)


def run_scale(job: EvalScale, console: Console) -> None:
    """Measure, print, write; raise ``RfedgeError`` naming the cases that were not held.

    The file is written after every group of cases: a run that breaks off keeps what was measured.
    """
    cases = cases_of(job)
    made = provenance([job.field])
    record = ScaleRecord.read(job.out, made) if job.add else ScaleRecord()
    shutil.rmtree(job.work, ignore_errors=True)
    job.published.mkdir(parents=True)
    size_px = parse_size(job.size) if job.size is not None else None
    convert_dataset(job.drive, job.reduced, size_px)
    publish(job.published, "street", job.field, EVERYWHERE, datetime.now(UTC))
    rows: list[ScaleRow] = []
    for case in cases:
        measured = case(job)
        rows += measured.rows
        record = record.plus(made, measured)
        record.write(job.out, made)
    Table("Several servers", columns(ScaleRow), rows).print(console)
    broken = [row.case for row in rows if not row.held]
    if broken:
        raise RfedgeError("not held: " + "; ".join(broken))


def cases_of(job: EvalScale) -> list[Case]:
    """Return the groups of cases that are asked for.

    Raises ``InvalidInput`` for none, and for what one of them cannot take.
    """
    cases: list[Case] = []
    if not (job.no_envoy or job.no_moves):
        cases.append(moves)
    if job.pairs and not job.no_envoy:
        cases.append(added_by_envoy)
    if job.planned:
        cases.append(_planned_rows)
    if job.nats:
        from lab.servers.nats import nats_rows

        cases.append(nats_rows)
    if job.ray_tiles is not None:
        from lab.servers.ray import ray_case
        from rfcore.extras import require

        require("ray", "ray")
        cases.append(ray_case(job.ray_tiles, job.ray_iterations))
    if not cases:
        raise InvalidInput("envoy", "nothing is to be measured; give --planned numbers")
    return cases


def planned_load(job: EvalScale) -> PlannedLoad:
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


def _planned_rows(job: EvalScale) -> Measured:
    plans = compare_with_plan(planned_load(job))
    rows = [
        ScaleRow.at_most(
            f"planned {plan.vehicles} vehicles: {plan.figure}, % off",
            _bound(plan.figure),
            abs(plan.difference_percent),
        )
        for plan in plans
    ]
    return Measured(rows, planning=plans)


def _bound(figure: str) -> float:
    """Return by how many percent a figure of a plan may be off."""
    return PLANNED_AGE_PERCENT if figure.startswith("age") else PLANNED_PERCENT


@dataclass
class Rounds:
    """Figures of all rounds."""

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
            lambda placed: set(placed) == there and sum(placed.values()) == vehicles
        )
        return max(placed.values()) * len(placed) / vehicles

    def add_server(self) -> None:
        """Start one more, tell Envoy of it, and wait until it is healthy there."""
        self.watch.add(self.group.start_server().address)
        self.group.list_servers()
        there = set(self.group.addresses)
        self.envoy.until(lambda placed: set(placed) == there)


def moves(job: EvalScale) -> Measured:
    """Kill, add and drain servers under the vehicles, then restart Envoy."""
    setup = EnvoySetup(envoy_binary(), job.config / "envoy.yaml", job.work / "envoy")
    rounds = Rounds()
    with ServerGroup(job.published, setup) as group, ExitStack() as stack, TwinWatch() as watch:
        for _ in range(job.servers):
            watch.add(group.start_server().address)
        fleet = Fleet(job.reduced, job.work / "fleet")
        site = Site(group, group.start_envoy(), fleet, watch)
        fleet.start(stack, site.envoy.address, job.vehicles, job.hz)
        rounds.over_mean.append(site.settled())
        for _ in range(job.rounds):
            _kill_one(site, rounds)
            _drain_one(site, rounds)
        _let_others_join(job, site, rounds)
        _restart_envoy(site, rounds)
        keys = sum(keyframes(read_lines(report)) for report in (*fleet.reports, *fleet.left))
        twice = shown_twice(watch.result())
    at_most = ScaleRow.at_most
    rows = [
        at_most("placement: most streams over the mean", MOST_OVER_MEAN, max(rounds.over_mean)),
        at_most("a server killed: Ack from another, p99, s", RESUME_S, p99(rounds.resumed_s)),
        at_most("a server drained: frames lost", 0, rounds.drained_frames),
        at_most(
            "a server added: most over the mean once others moved",
            MOST_OVER_MEAN,
            max(rounds.after_adding),
        ),
        at_most(
            "a server added: most over the mean once others joined",
            MOST_OVER_MEAN,
            max(rounds.after_joining),
        ),
        at_most("Envoy restarted: Ack again, p99, s", RESTART_S, p99(rounds.restarted_s)),
        at_most("moved: pictures without the render as reference", 0, keys),
        at_most("moved: vehicles that two servers show", 0, twice),
    ]
    return Measured(rows)


def _kill_one(site: Site, rounds: Rounds) -> None:
    killed = site.group.servers.pop(0)
    since_ns = time.time_ns()
    killed.process.kill()
    rounds.over_mean.append(site.settled())
    site.fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in site.fleet.lines()]
    rounds.resumed_s += [s for s in took_s if s is not None]
    site.add_server()


def _drain_one(site: Site, rounds: Rounds) -> None:
    """Drain the server that has been there for longest; its vehicles fill the one just added."""
    drained = site.group.servers.pop(0)
    since_ns = time.time_ns()
    drained.process.send_signal(signal.SIGTERM)
    if drained.process.wait(WAIT_S) != 0:
        raise RfedgeError(f"{drained.name} did not end well; see {site.group.setup.folder}")
    rounds.after_adding.append(site.settled())
    until_ns = time.time_ns()
    site.fleet.until_acked(until_ns)
    rounds.drained_frames += sum(
        failures(lines, since_ns, until_ns) for lines in site.fleet.lines()
    )
    site.add_server()


def _let_others_join(job: EvalScale, site: Site, rounds: Rounds) -> None:
    """Start as many vehicles as an even share, and end them; the server just added has no stream.

    Envoy does not move streams that are open, so that only who comes later fills it.
    """
    share = round(job.vehicles / len(site.group.servers))
    with ExitStack() as joined:
        site.fleet.start(joined, site.envoy.address, max(1, share), job.hz)
        rounds.after_joining.append(site.settled())
    site.fleet.leave(job.vehicles)


def _restart_envoy(site: Site, rounds: Rounds) -> None:
    """End Envoy and start it again at its port, with the same servers."""
    group, port = site.group, int(site.envoy.address.rpartition(":")[2])
    group.setup = replace(group.setup, port=port)
    site.envoy.process.kill()
    site.envoy.process.wait()
    since_ns = time.time_ns()
    again = replace(site, envoy=group.start_envoy())
    rounds.over_mean.append(again.settled())
    again.fleet.until_acked(time.time_ns())
    took_s = [resumed_s(lines, since_ns) for lines in again.fleet.lines()]
    rounds.restarted_s += [s for s in took_s if s is not None]


def added_by_envoy(job: EvalScale) -> Measured:
    """One vehicle, straight to a server and through Envoy in turn: the p99 of its link, compared.

    The link is a frame's time from sending to Ack without the server's own; the median of the
    pairs' differences is what Envoy adds.
    """
    setup = EnvoySetup(envoy_binary(), job.config / "envoy.yaml", job.work / "one")
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


def _link_p99_ms(job: EvalScale, address: str, name: str) -> float:
    fleet = Fleet(job.reduced, job.work / name)
    with ExitStack() as stack:
        fleet.start(stack, address, 1, PAIR_HZ)
        since_ns = time.time_ns() + 10**9
        time.sleep(1.0 + job.seconds)
    (lines,) = fleet.lines()
    counted = [x for x in lines if x["result"] == "acked" and x["capture_time_ns"] >= since_ns]
    if len(counted) < job.seconds * PAIR_HZ / 2:
        raise RfedgeError(f"{name}: {len(counted)} frames in {job.seconds:g} s are too few")
    return p99(line["stage_ms"]["link"] for line in counted)
