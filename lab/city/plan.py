"""The plan of a city: its flow minute by minute, cell by cell and server by server, and its limits.

Figures of a minute are means over its steps; shares of what there is (``*_share``) are those of its
busiest step. Ages are of the minute's mean flow, once a minute for every cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lab.city.city import City, Floats
from lab.city.flow import Costs, Flow, SharedLoad, age_samples_s, city_flow
from lab.city.traffic import TrafficBlock
from rfcore.errors import InvalidInput
from rfedge.report.tables import shown

PERCENTILES = (0.5, 0.95, 0.99)
AGE_LIMIT = "age of pictures, p99"


@dataclass(frozen=True, eq=False)
class Minute:
    """The mean flow of a minute: [C] of cells, [S] of servers; ``ages_s`` [C, 3]: percentiles 50,
    95 and 99 of each cell, NaN where nobody is; ``pooled_s`` [3]: of all pictures of the city."""

    start_s: float
    outside: float
    vehicles: Floats
    handovers_per_s: Floats
    begun_per_s: Floats
    served: Floats
    rate_hz: Floats
    uplink_bps: Floats
    downlink_bps: Floats
    cores: Floats
    uplink_share: Floats
    downlink_share: Floats
    load_share: Floats
    stream_share: Floats
    ages_s: Floats
    pooled_s: Floats


@dataclass(frozen=True)
class MinuteRow:
    """The city in a minute from ``at_s`` on. ``rate_hz``: pictures a second of a camera, mean of
    those served; ages are None while nobody is."""

    at_s: float = field(metadata=shown("at s", ".0f"))
    vehicles: float = field(metadata=shown("vehicles", ".0f"))
    outside: float
    served: float
    refused: float = field(metadata=shown("refused", ".0f"))
    rate_hz: float = field(metadata=shown("Hz", ".1f"))
    handovers_per_s: float = field(metadata=shown("handovers a second", ".1f"))
    begun_per_s: float
    uplink_mbps: float = field(metadata=shown("Mbit/s up", ".0f"))
    downlink_mbps: float
    cores: float = field(metadata=shown("cores", ".1f"))
    age_p50_ms: float | None = None
    age_p95_ms: float | None = None
    age_p99_ms: float | None = field(default=None, metadata=shown("age p99 ms", ".0f"))


@dataclass(frozen=True)
class CellRow:
    """A cell: its most vehicles in a minute's mean, the share of vehicle time that was refused, its
    least rate, most of shares and ages."""

    name: str
    server: str
    east_m: float
    north_m: float
    radius_m: float
    vehicles: float
    refused_percent: float
    rate_hz: float
    uplink_share: float
    downlink_share: float
    age_p99_ms: float | None = None


@dataclass(frozen=True)
class ServerRow:
    """A server: most vehicles, mean and most of cores in use and of Mbit/s received, most Mbit/s
    sent and handovers to it, most of what is asked of the cores that it may promise."""

    name: str = field(metadata=shown("server"))
    cores: float = field(metadata=shown("cores", ".0f"))
    vehicles: float = field(metadata=shown("vehicles", ".0f"))
    refused_percent: float = field(metadata=shown("refused %", ".1f"))
    busy_cores: float
    most_busy_cores: float = field(metadata=shown("cores in use", ".1f"))
    uplink_mbps: float
    most_uplink_mbps: float = field(metadata=shown("Mbit/s up", ".0f"))
    most_downlink_mbps: float
    most_handovers_per_s: float
    load_share: float = field(metadata=shown("asked of its cores", ".2f"))
    age_p99_ms: float | None = field(default=None, metadata=shown("age p99 ms", ".0f"))


@dataclass(frozen=True)
class LimitRow:
    """The share of ``limit`` that is asked for, where and when it is largest.

    ``broken_at_s``: when it is above 1 first, None if never; ``demand_factor``: how many times the
    demand brings it to 1, None of ages, which do not grow with the demand.
    """

    limit: str = field(metadata=shown("limit"))
    share: float = field(metadata=shown("asked", ".2f"))
    where: str = field(metadata=shown("where"))
    at_s: float = field(metadata=shown("at s", ".0f"))
    demand_factor: float | None = field(default=None, metadata=shown("times the demand", ".2f"))
    broken_at_s: float | None = field(default=None, metadata=shown("broken from s", ".0f"))


@dataclass(frozen=True)
class CityPlan:
    """A city with its costs, and what every minute, cell and server comes to."""

    city: City
    costs: Costs
    rows: Sequence[MinuteRow]
    cells: Sequence[CellRow]
    servers: Sequence[ServerRow]
    limits: Sequence[LimitRow]

    @property
    def first_broken(self) -> LimitRow | None:
        """The limit that is broken first, the one most exceeded of several; None if all hold."""
        broken = [row for row in self.limits if row.broken_at_s is not None]
        return min(broken, key=lambda row: (row.broken_at_s, -row.share), default=None)


def plan_city(city: City, costs: Costs, traffic: Iterable[TrafficBlock]) -> CityPlan:
    """Return the plan of a city under some traffic; raise ``InvalidInput`` for none at all."""
    minutes = [_minute(city, costs, block) for block in traffic]
    if not minutes:
        raise InvalidInput("traffic", "there is no step of it")
    return CityPlan(
        city=city,
        costs=costs,
        rows=[_minute_row(minute) for minute in minutes],
        cells=_cell_rows(city, minutes),
        servers=_server_rows(city, minutes),
        limits=_limits(city, minutes),
    )


def _minute(city: City, costs: Costs, block: TrafficBlock) -> Minute:
    flow = city_flow(city, costs, block)
    served, rate_hz = flow.served.mean(axis=0), _mean_rate_hz(flow)
    ages_s, pooled_s = _ages_s(city, costs, flow, served, rate_hz)
    return Minute(
        start_s=block.start_s,
        outside=float(block.outside.mean()),
        vehicles=block.vehicles.mean(axis=0),
        handovers_per_s=block.handovers_per_s.mean(axis=0),
        begun_per_s=block.begun_per_s.mean(axis=0),
        served=served,
        rate_hz=rate_hz,
        uplink_bps=flow.uplink_bps.mean(axis=0),
        downlink_bps=flow.downlink_bps.mean(axis=0),
        cores=flow.cores.mean(axis=0),
        uplink_share=flow.uplink_share.max(axis=0),
        downlink_share=flow.downlink_share.max(axis=0),
        load_share=flow.load_share.max(axis=0),
        stream_share=flow.stream_share.max(axis=0),
        ages_s=ages_s,
        pooled_s=pooled_s,
    )


def _mean_rate_hz(flow: Flow) -> Floats:
    """Return the rate of each cell's vehicles, the mean over those who were there, [C]."""
    pictures = (flow.served * flow.rate_hz).sum(axis=0)
    there = flow.served.sum(axis=0)
    mean_hz = pictures / np.maximum(there, 1e-12)
    return np.asarray(np.where(there > 0, mean_hz, flow.rate_hz.mean(axis=0)))


def _ages_s(
    city: City, costs: Costs, flow: Flow, served: Floats, rate_hz: Floats
) -> tuple[Floats, Floats]:
    """Return the percentiles of each cell's ages [C, 3] and of all of them [3]; NaN for nobody."""
    ages_s = np.full((len(served), len(PERCENTILES)), np.nan)
    there = np.flatnonzero(served * rate_hz > 0)
    if not len(there):
        return ages_s, np.full(len(PERCENTILES), np.nan)
    server = city.cells.server[there]
    shared = SharedLoad(
        vehicles=served[there],
        rate_hz=rate_hz[there],
        uplink_bps=city.cells.uplink_bps[there],
        link_limited=flow.link_limited.mean(axis=0)[there],
        held=flow.held.mean(axis=0)[there],
        server_vehicles=city.at_server(served)[server],
        server_busy=flow.cores.mean(axis=0)[server],
        server_cores=city.servers.cores[server],
    )
    samples_s = np.sort(age_samples_s(costs, shared, city.seed), axis=1)
    ages_s[there] = np.quantile(samples_s, PERCENTILES, axis=1).T
    weights = np.repeat((served * rate_hz)[there], samples_s.shape[1])
    return ages_s, _weighted_quantiles(samples_s.ravel(), weights)


def _weighted_quantiles(values: Floats, weights: Floats) -> Floats:
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    at = np.searchsorted(reached, np.array(PERCENTILES) * reached[-1])
    return np.asarray(values[order][np.minimum(at, len(values) - 1)])


def _minute_row(minute: Minute) -> MinuteRow:
    served = float(minute.served.sum())
    pictures = float((minute.served * minute.rate_hz).sum())
    p50_ms, p95_ms, p99_ms = (_ms(age_s) for age_s in minute.pooled_s)
    return MinuteRow(
        at_s=minute.start_s,
        vehicles=float(minute.vehicles.sum()),
        outside=minute.outside,
        served=served,
        refused=float((minute.vehicles - minute.served).sum()),
        rate_hz=pictures / served if served else 0.0,
        handovers_per_s=float(minute.handovers_per_s.sum()),
        begun_per_s=float(minute.begun_per_s.sum()),
        uplink_mbps=float(minute.uplink_bps.sum()) / 1e6,
        downlink_mbps=float(minute.downlink_bps.sum()) / 1e6,
        cores=float(minute.cores.sum()),
        age_p50_ms=p50_ms,
        age_p95_ms=p95_ms,
        age_p99_ms=p99_ms,
    )


def _ms(age_s: float) -> float | None:
    return None if np.isnan(age_s) else 1e3 * float(age_s)


def _over_time(minutes: Sequence[Minute], name: str) -> Floats:
    """Return one of the minutes' arrays over time, [I, C] or [I, S]."""
    return np.stack([getattr(minute, name) for minute in minutes])


def _worst_ms(ages_s: Floats) -> float | None:
    """Return the largest of ages that may all be NaN, in ms."""
    known = ages_s[~np.isnan(ages_s)]
    return 1e3 * float(known.max()) if known.size else None


def _cell_rows(city: City, minutes: Sequence[Minute]) -> list[CellRow]:
    cells = city.cells
    vehicles, served = _over_time(minutes, "vehicles"), _over_time(minutes, "served")
    refused = _refused_percent(vehicles, served)
    least_hz = _over_time(minutes, "rate_hz").min(axis=0)
    uplink = _over_time(minutes, "uplink_share").max(axis=0)
    downlink = _over_time(minutes, "downlink_share").max(axis=0)
    ages_s = _over_time(minutes, "ages_s")[..., -1]
    return [
        CellRow(
            name=name,
            server=city.servers.names[cells.server[number]],
            east_m=float(cells.centre_m[number, 0]),
            north_m=float(cells.centre_m[number, 1]),
            radius_m=float(cells.radius_m[number]),
            vehicles=float(vehicles[:, number].max()),
            refused_percent=float(refused[number]),
            rate_hz=float(least_hz[number]),
            uplink_share=float(uplink[number]),
            downlink_share=float(downlink[number]),
            age_p99_ms=_worst_ms(ages_s[:, number]),
        )
        for number, name in enumerate(cells.names)
    ]


def _refused_percent(vehicles: Floats, served: Floats) -> Floats:
    """Return the share of vehicle time without a stream, [C] or [S] of [I, ...]."""
    there = vehicles.sum(axis=0)
    refused = np.maximum(vehicles - served, 0.0).sum(axis=0)
    return np.asarray(100 * refused / np.maximum(there, 1e-12))


def _server_rows(city: City, minutes: Sequence[Minute]) -> list[ServerRow]:
    def at_server(name: str) -> Floats:
        return city.at_server(_over_time(minutes, name))

    vehicles, served = at_server("vehicles"), at_server("served")
    refused = _refused_percent(vehicles, served)
    cores, load = _over_time(minutes, "cores"), _over_time(minutes, "load_share").max(axis=0)
    uplink_mbps, downlink_mbps = at_server("uplink_bps") / 1e6, at_server("downlink_bps") / 1e6
    handovers = at_server("handovers_per_s").max(axis=0)
    ages_s = _over_time(minutes, "ages_s")[..., -1]
    return [
        ServerRow(
            name=name,
            cores=float(city.servers.cores[number]),
            vehicles=float(vehicles[:, number].max()),
            refused_percent=float(refused[number]),
            busy_cores=float(cores[:, number].mean()),
            most_busy_cores=float(cores[:, number].max()),
            uplink_mbps=float(uplink_mbps[:, number].mean()),
            most_uplink_mbps=float(uplink_mbps[:, number].max()),
            most_downlink_mbps=float(downlink_mbps[:, number].max()),
            most_handovers_per_s=float(handovers[number]),
            load_share=float(load[number]),
            age_p99_ms=_worst_ms(ages_s[:, city.cells.server == number]),
        )
        for number, name in enumerate(city.servers.names)
    ]


def _limits(city: City, minutes: Sequence[Minute]) -> list[LimitRow]:
    starts_s = [minute.start_s for minute in minutes]
    ages = 1e3 * np.nan_to_num(_over_time(minutes, "ages_s")[..., -1])
    limits = (
        ("uplink of a cell", _over_time(minutes, "uplink_share"), city.cells.names),
        ("downlink of a cell", _over_time(minutes, "downlink_share"), city.cells.names),
        ("cores that a server may promise", _over_time(minutes, "load_share"), city.servers.names),
        ("streams of a server", _over_time(minutes, "stream_share"), city.servers.names),
        (AGE_LIMIT, ages / city.vehicle.max_age_ms, city.cells.names),
    )
    return [_limit(name, shares, starts_s, places) for name, shares, places in limits]


def _limit(name: str, shares: Floats, starts_s: Sequence[float], places: Sequence[str]) -> LimitRow:
    minute, place = np.unravel_index(int(shares.argmax()), shares.shape)
    share = float(shares[minute, place])
    broken = np.flatnonzero(shares.max(axis=1) > 1)
    return LimitRow(
        limit=name,
        share=share,
        where=places[int(place)],
        at_s=starts_s[int(minute)],
        demand_factor=1 / share if share > 0 and name != AGE_LIMIT else None,
        broken_at_s=starts_s[int(broken[0])] if len(broken) else None,
    )
