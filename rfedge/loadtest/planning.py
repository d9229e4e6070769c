"""What loads are told to take before they are run, and how right that was.

``vehicles_carried``: vehicles of a cell share its throughput. Each sends the drive's packets at its
rate, at moments spread over a period; a packet that is transmitted later than the budget is late.
The caller takes the rest of the deadline (server, way back, encoding) off the budget.

``compare_with_plan``: prerecorded vehicles, each on its own link, to a server that decodes against
kept renders, beside the flow model of a city of as many cells. The model's costs of a frame are
measured with other numbers of vehicles: cores as a straight line through two loads, and what of the
ages at the larger one the model does not explain (the way back among it, and the machine).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mec_server.config import AdmissionLimits
from rfcore.errors import InvalidInput
from rfcore.link import LinkProfile
from rfcore.link.plan import Arrival, delivery_times
from rfcore.link.profile_file import read_link
from rfcore.wire.convert import client_message_to_bytes
from rfedge.loadtest.plan import Load, Mode
from rfedge.loadtest.prerecorded import PrerecordedDrive
from rfedge.loadtest.run import Run, TestBed, recorded, run_load
from rfedge.sizing.city import Admission, Cells, City, Servers, VehicleKind
from rfedge.sizing.city_plan import CityPlan, plan_city
from rfedge.sizing.estimate import Assumptions, Demand
from rfedge.sizing.flow import AGE_SAMPLES, Costs, Shared, age_samples_s, answer_bytes
from rfedge.sizing.traffic import TrafficBlock

__all__ = [
    "CLOSE",
    "RATES_MBPS",
    "LoadFigures",
    "PlannedLoad",
    "PlannedRow",
    "Traffic",
    "compare_with_plan",
    "fitted_costs",
    "largest_held",
    "on_time_share",
    "planned_figures",
    "vehicles_carried",
]

CLOSE = 1.1
"""Ratio of bounds at which the search stops: short runs on a noisy machine repeat no closer."""


def largest_held(first: int, held: Callable[[int], bool], most: int = 1000) -> int:
    """Return the largest count for which ``held`` was true, 0 if it is for none up to ``first``.

    ``held`` is asked once for each count. Found exactly below ten, and within a tenth above.
    """
    low, high = 0, first
    while high <= most and held(high):
        low, high = high, 2 * high
    high = min(high, most + 1)
    while high - low > 1 and high > CLOSE * low:
        middle = (low + high) // 2
        low, high = (middle, high) if held(middle) else (low, middle)
    return low


RATES_MBPS = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 32.0, 64.0, 128.0)
MOST = 64
PERIODS = 50


@dataclass(frozen=True)
class Traffic:
    """What one vehicle sends, ``hz`` packets a second of ``sizes_bytes`` in turn, and the share of
    them that must be through within ``budget_s``."""

    sizes_bytes: Sequence[int]
    hz: float
    budget_s: float
    share: float = 0.99


def vehicles_carried(traffic: Traffic, rate_bps: float) -> int:
    """Return how many vehicles an uplink of ``rate_bps`` carries, at most 64."""

    def held(vehicles: int) -> bool:
        return on_time_share(traffic, rate_bps, vehicles) >= traffic.share

    return largest_held(1, held, MOST)


def on_time_share(traffic: Traffic, rate_bps: float, vehicles: int) -> float:
    """Return the share of packets that are through within the budget."""
    sizes, period_s = traffic.sizes_bytes, 1.0 / traffic.hz
    schedule = [
        Arrival((n + v / vehicles) * period_s, sizes[(n + v) % len(sizes)])
        for n in range(PERIODS)
        for v in range(vehicles)
    ]
    due_s = delivery_times(LinkProfile(rate_bps), schedule)
    in_time = (
        done_s - sent.at_s <= traffic.budget_s for sent, done_s in zip(schedule, due_s, strict=True)
    )
    return sum(in_time) / len(schedule)


FIT_VEHICLES = (6, 60)
"""Vehicles of the two loads that the costs are measured with; plans are trusted in between."""


@dataclass(frozen=True)
class PlannedLoad:
    """Loads to compare with their plan; ``link``: the profile of each vehicle's own link.

    ``seconds`` are counted, after ``warm_up_s``, in each of ``runs`` runs.
    """

    vehicles: tuple[int, ...]
    hz: float
    seconds: float
    link: Path
    bed: TestBed
    warm_up_s: float = 5.0
    runs: int = 3

    def __post_init__(self) -> None:
        if not self.vehicles or any(not 1 <= count <= 1000 for count in self.vehicles):
            raise InvalidInput("planned", f"{self.vehicles} are not one or more of 1..1000")
        if not 1 <= self.runs <= 100:
            raise InvalidInput("planned-runs", f"{self.runs} is outside 1..100")
        if set(self.vehicles) & set(FIT_VEHICLES):
            raise InvalidInput(
                "planned", f"with {FIT_VEHICLES} vehicles costs are measured; plan other numbers"
            )

    def load(self, vehicles: int) -> Load:
        """Return the load of so many vehicles."""
        return Load(
            Mode.RECEIVER,
            vehicles,
            self.hz,
            duration_s=self.seconds,
            warm_up_s=self.warm_up_s,
            link=self.link,
        )


@dataclass(frozen=True)
class LoadFigures:
    """What a load takes of the server, of all uplinks, and how old its pictures get."""

    vehicles: int
    cores: float
    uplink_mbps: float
    age_p99_ms: float
    ages_ms: tuple[float, ...] = ()


@dataclass(frozen=True)
class PlannedRow:
    """A figure as planned and as measured, and the difference of the plan from it."""

    vehicles: int
    figure: str
    planned: float
    measured: float
    difference_percent: float


def compare_with_plan(job: PlannedLoad) -> list[PlannedRow]:
    """Run every load in turn, ``job.runs`` times, and return three rows for each that is planned.

    Medians of the runs count. Raises ``RfedgeError`` naming the process that failed.
    """
    taken: dict[int, list[LoadFigures]] = {n: [] for n in (*FIT_VEHICLES, *job.vehicles)}
    for _ in range(job.runs):
        for count, figures in taken.items():
            figures.append(_measured(job, run_load(job.load(count), job.bed)))
    few, more = (_median(taken[count]) for count in FIT_VEHICLES)
    costs, idle_cores = fitted_costs(job, few, more)
    rows: list[PlannedRow] = []
    for count in job.vehicles:
        rows += _rows(planned_figures(job, costs, idle_cores, count), _median(taken[count]))
    return rows


def _median(runs: Sequence[LoadFigures]) -> LoadFigures:
    """Return the median of each figure, with the ages of the run whose p99 is the median."""
    by_age = sorted(runs, key=lambda figures: figures.age_p99_ms)
    middle = by_age[len(runs) // 2]
    return replace(
        middle,
        cores=float(np.median([figures.cores for figures in runs])),
        uplink_mbps=float(np.median([figures.uplink_mbps for figures in runs])),
    )


def _rows(planned: LoadFigures, measured: LoadFigures) -> list[PlannedRow]:
    rows = []
    for figure in ("cores", "uplink_mbps", "age_p99_ms"):
        told, seen = getattr(planned, figure), getattr(measured, figure)
        if not seen > 0:
            raise InvalidInput("planning", f"{measured.vehicles} vehicles: {figure} is {seen:g}")
        rows.append(PlannedRow(planned.vehicles, figure, told, seen, 100 * (told / seen - 1)))
    return rows


def _measured(job: PlannedLoad, run: Run) -> LoadFigures:
    links = [json.loads(x) for x in (job.bed.work / "links.jsonl").read_text().splitlines()]
    seconds = run.load.warm_up_s + run.load.duration_s
    uplink_bytes = sum(link["uplink"]["bytes"] for link in links)
    return LoadFigures(
        vehicles=run.load.vehicles,
        cores=run.row.server_cores,
        uplink_mbps=8e-6 * uplink_bytes / seconds,
        age_p99_ms=float(np.quantile(run.latency_ms, 0.99)) if run.latency_ms else 0.0,
        ages_ms=tuple(run.latency_ms),
    )


def fitted_costs(job: PlannedLoad, few: LoadFigures, more: LoadFigures) -> tuple[Costs, float]:
    """Return what a frame costs, and the cores that the server takes without any.

    Raises ``InvalidInput`` for loads that tell nothing.
    """
    added = more.cores - few.cores
    server_s = added / (more.vehicles - few.vehicles) / job.hz
    if not (server_s > 0 and more.ages_ms):
        raise InvalidInput(
            "planning",
            f"{more.vehicles} vehicles took {added:g} cores more than {few.vehicles}, and "
            f"{len(more.ages_ms)} pictures were acknowledged: the machine was too busy, or the "
            "load too short; measure again",
        )
    costs = _unloaded_costs(job, server_s)
    idle_cores = few.cores - few.vehicles * job.hz * server_s
    return replace(costs, unexplained_s=_unexplained_s(job, costs, more)), idle_cores


def _unexplained_s(job: PlannedLoad, costs: Costs, load: LoadFigures) -> tuple[float, ...]:
    """Return by how much the ages of a load exceed the model's, rank by rank."""
    ranks = (np.arange(AGE_SAMPLES) + 0.5) / AGE_SAMPLES
    ages_s = np.quantile(load.ages_ms, ranks) / 1e3
    told_s = np.sort(age_samples_s(costs, _shared(job, costs, load.vehicles), seed=1)[0])
    return tuple((ages_s - told_s).tolist())


def _shared(job: PlannedLoad, costs: Costs, vehicles: int) -> Shared:
    """Return what the frames of any of the vehicles meet: their own link, and all at the server."""
    values = {
        "vehicles": 1.0,
        "rate_hz": costs.hz,
        "uplink_bps": read_link(job.link).uplink.profile.rate_bps,
        "link_limited": 0.0,
        "held": 0.0,
        "server_vehicles": float(vehicles),
        "server_busy": vehicles * costs.hz * costs.server_s,
        "server_cores": float(job.bed.workers),
    }
    return Shared(**{name: np.array([value]) for name, value in values.items()})


def _unloaded_costs(job: PlannedLoad, server_s: float) -> Costs:
    drive = PrerecordedDrive.read(recorded(job.load(1), job.bed))
    sizes = np.array([len(client_message_to_bytes(frame)) for frame in drive.chain])
    overhead = 1 + Assumptions().overhead_percent / 100
    return Costs(
        cameras=1,
        hz=job.hz,
        frame_bytes=overhead * float(sizes.mean()),
        frame_ratios=tuple((sizes / sizes.mean()).tolist()),
        sender_s=0.0,
        server_s=server_s,
        propagation_s=read_link(job.link).uplink.profile.delay_s,
        answer_bytes=overhead * answer_bytes(),
    )


def planned_figures(
    job: PlannedLoad, costs: Costs, idle_cores: float, vehicles: int
) -> LoadFigures:
    """Return what the flow model says of a load."""
    row = _plan(job, costs, vehicles).rows[0]
    return LoadFigures(vehicles, row.cores + idle_cores, row.uplink_mbps, row.age_p99_ms or 0.0)


def _plan(job: PlannedLoad, costs: Costs, vehicles: int) -> CityPlan:
    """Return the plan of a minute of a city of one vehicle a cell, all at one server that refuses
    nobody."""
    link = read_link(job.link)
    cells = Cells(
        names=tuple(f"link-{number}" for number in range(vehicles)),
        centre_m=np.zeros((vehicles, 2)),
        radius_m=np.ones(vehicles),
        uplink_bps=np.full(vehicles, link.uplink.profile.rate_bps),
        downlink_bps=np.full(vehicles, link.downlink.profile.rate_bps),
        server=np.zeros(vehicles, dtype=np.int64),
        weight=np.ones(vehicles),
    )
    limits = AdmissionLimits(load=1.0, lowest_hz=min(0.1, costs.hz))
    city = City(
        vehicle=VehicleKind(Demand(1, 1, 1, costs.hz, 34.0)),
        cells=cells,
        servers=Servers(("server",), np.array([float(job.bed.workers)])),
        admission=Admission(limits, streams=100_000),
    )
    there, nobody = np.ones((1, vehicles)), np.zeros((1, vehicles))
    return plan_city(city, costs, [TrafficBlock(0.0, 1.0, there, nobody, nobody, np.zeros(1))])
