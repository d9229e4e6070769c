"""Loads measured beside what the flow model of a city says of them.

Prerecorded vehicles, each on its own link, drive to a server that decodes against kept renders,
beside a city of as many cells. The model's costs of a frame are measured with other numbers of
vehicles: cores as a straight line through two loads, and what of the ages at the larger one the
model does not explain (the way back among it, and the machine).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lab.city.city import Admission, Cells, City, Servers, VehicleKind
from lab.city.flow import AGE_SAMPLES, Costs, SharedLoad, age_samples_s, answer_bytes
from lab.city.plan import CityPlan, plan_city
from lab.city.traffic import TrafficBlock
from mec_server.config import AdmissionLimits
from rfcore.errors import InvalidInput
from rfcore.link.plan import read_link
from rfcore.wire.head import FrameWriter
from rfedge.loadtest.plan import Load, Mode
from rfedge.loadtest.prerecorded import PrerecordedDrive
from rfedge.loadtest.run import Run, TestBed, recorded, run_load
from rfedge.sizing.estimate import Assumptions, Demand

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
    """The cores and uplink that a load takes, and the ages of its pictures."""

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


def _shared(job: PlannedLoad, costs: Costs, vehicles: int) -> SharedLoad:
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
    return SharedLoad(**{name: np.array([value]) for name, value in values.items()})


def _unloaded_costs(job: PlannedLoad, server_s: float) -> Costs:
    drive = PrerecordedDrive.read(recorded(job.load(1), job.bed))
    messages = FrameWriter(drive.hello).in_order(drive.chain)
    sizes = np.array([len(message) for message in messages])
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
