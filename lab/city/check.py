"""The flow model beside the sessions: sampled servers, a row for each figure of either.

Samples are stratified: all servers in all minutes, ordered by how hard they are pressed (the larger
of what is asked of their cores and of their busiest cell's uplink), are cut into as many parts of
one size as there are samples, and one is drawn of each. So idle, typical and pressed servers are
all looked at. The model is asked about exactly the vehicles that the sessions have: whole ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lab.city.city import City
from lab.city.flow import Costs
from lab.city.plan import CityPlan, MinuteRow, plan_city
from lab.city.sessions import SampledServer, SessionFigures, run_sessions
from lab.city.traffic import TrafficBlock
from rfcore.errors import InvalidInput

__all__ = ["CheckPlan", "CheckRow", "check_plan", "flow_of", "largest_differences"]

MOST_SAMPLES = 1000


@dataclass(frozen=True)
class CheckPlan:
    """The number of servers that are sampled, and the time each runs on the virtual clock."""

    samples: int = 9
    warm_up_s: float = 20.0
    counted_s: float = 30.0

    def __post_init__(self) -> None:
        if not 0 <= self.samples <= MOST_SAMPLES:
            raise InvalidInput("samples", f"{self.samples} is outside 0..{MOST_SAMPLES}")
        if not (0 <= self.warm_up_s <= 3600 and 1 <= self.counted_s <= 3600):
            raise InvalidInput(
                "sample-s", f"{self.counted_s:g} s after {self.warm_up_s:g} s are outside 1..3600"
            )


@dataclass(frozen=True)
class CheckRow:
    """A figure of a sampled server: by the flow model, and as the sessions came to it.

    ``difference_percent``: of the model's from the sessions'; None where those have none.
    """

    server: str
    at_s: float
    vehicles: int
    figure: str
    flow: float
    sessions: float
    difference_percent: float | None = None


def check_plan(plan: CityPlan, check: CheckPlan) -> list[CheckRow]:
    """Return the rows of every sample, in the order of how hard their servers are pressed."""
    rows: list[CheckRow] = []
    for minute, server in _samples(plan, check.samples):
        sampled = _sampled(plan, minute, server)
        figures = run_sessions(plan.city, plan.costs, sampled, check.warm_up_s, check.counted_s)
        flow = flow_of(plan.city, plan.costs, sampled)
        rows += _rows(plan, (minute, sampled), flow, figures)
    return rows


def _samples(plan: CityPlan, count: int) -> Iterator[tuple[int, int]]:
    """Yield minutes and servers, one of each stratum; those without a vehicle are left out."""
    city, minutes = plan.city, plan.minutes
    load = np.stack([minute.load_share for minute in minutes])
    uplink = np.zeros_like(load)
    for shares, minute in zip(uplink, minutes, strict=True):
        np.maximum.at(shares, city.cells.server, minute.uplink_share)
    there = np.stack([city.at_server(np.rint(minute.vehicles)) for minute in minutes])
    pressed = np.where(there > 0, np.maximum(load, uplink), -1.0)
    order = np.argsort(pressed, axis=None, kind="stable")
    order = order[pressed.ravel()[order] >= 0]
    random = np.random.default_rng(city.seed)
    for stratum in np.array_split(order, count) if count else ():
        if len(stratum):
            row, server = np.unravel_index(int(random.choice(stratum)), pressed.shape)
            yield int(row), int(server)


def _sampled(plan: CityPlan, minute: int, server: int) -> SampledServer:
    flow = plan.minutes[minute]
    cells = np.flatnonzero(plan.city.cells.server == server)
    entries_per_s = flow.handovers_per_s + flow.begun_per_s
    return SampledServer(
        server,
        {int(cell): int(np.rint(flow.vehicles[cell])) for cell in cells},
        {int(cell): float(entries_per_s[cell]) for cell in cells},
    )


def flow_of(city: City, costs: Costs, sampled: SampledServer) -> MinuteRow:
    """Return what the flow model says of the sampled server alone."""
    vehicles, entries_per_s = np.zeros((1, len(city.cells))), np.zeros((1, len(city.cells)))
    for cell, count in sampled.vehicles.items():
        vehicles[0, cell] = count
        entries_per_s[0, cell] = sampled.entries_per_s.get(cell, 0.0) if count else 0.0
    nobody = np.zeros_like(vehicles)
    block = TrafficBlock(0.0, 1.0, vehicles, entries_per_s, nobody, np.zeros(1))
    return plan_city(city, costs, [block]).rows[0]


def _age_ms(percentile: float) -> Callable[[SessionFigures], float]:
    def age_ms(figures: SessionFigures) -> float:
        if not figures.ages_s:
            return 0.0
        return 1e3 * float(np.quantile(figures.ages_s, percentile))

    return age_ms


FIGURES: Sequence[tuple[str, Callable[[MinuteRow], float], Callable[[SessionFigures], float]]] = (
    ("vehicles served", lambda row: row.served, lambda f: f.served),
    ("uplink, Mbit/s", lambda row: row.uplink_mbps, lambda f: f.uplink_bps / 1e6),
    ("downlink, Mbit/s", lambda row: row.downlink_mbps, lambda f: f.downlink_bps / 1e6),
    ("cores", lambda row: row.cores, lambda f: f.cores),
    ("age p50, ms", lambda row: row.age_p50_ms or 0.0, _age_ms(0.5)),
    ("age p95, ms", lambda row: row.age_p95_ms or 0.0, _age_ms(0.95)),
    ("age p99, ms", lambda row: row.age_p99_ms or 0.0, _age_ms(0.99)),
)


def _rows(
    plan: CityPlan, sample: tuple[int, SampledServer], flow: MinuteRow, figures: SessionFigures
) -> Iterator[CheckRow]:
    minute, sampled = sample
    vehicles = sum(sampled.vehicles.values())
    pictures_per_s = flow.served * flow.rate_hz * plan.costs.cameras
    values = [(name, of_flow(flow), of_sessions(figures)) for name, of_flow, of_sessions in FIGURES]
    values.insert(1, ("pictures a second", pictures_per_s, figures.pictures_per_s))
    for name, by_flow, by_sessions in values:
        yield CheckRow(
            server=plan.city.servers.names[sampled.server],
            at_s=plan.minutes[minute].start_s,
            vehicles=vehicles,
            figure=name,
            flow=by_flow,
            sessions=by_sessions,
            difference_percent=100 * (by_flow / by_sessions - 1) if by_sessions else None,
        )


def largest_differences(rows: Sequence[CheckRow]) -> list[tuple[str, float, float]]:
    """Return each figure with the median and the largest of its differences, in percent."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row.difference_percent is not None:
            found.setdefault(row.figure, []).append(abs(row.difference_percent))
    return [(name, float(np.median(values)), max(values)) for name, values in found.items()]
