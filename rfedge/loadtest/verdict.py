"""The verdict on one run: whether the load was held, and which resource limits it.

A frame is on time when its Ack was back within the deadline, counted from the moment the picture
was due. Frames that were dropped, refused or unanswered were not on time.

Every resource has a utilisation above which work queues up for it. If a bound was broken, the first
resource above its own is named, else the one nearest to it. The load generator comes first: where
the test's own vehicles are the limit, the run says nothing about the server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rfcore.extras import needs
from rfedge.loadtest.plan import Bounds

with needs("loadtest"):
    from scipy.stats import binomtest

__all__ = [
    "Measured",
    "Resources",
    "VehicleCount",
    "Verdict",
    "judge",
    "limit",
    "nearest",
    "share_at_least",
]


BUSY = 0.85
"""Utilisation of a core, a link or a worker above which work queues up.

At 85 % the mean queue of an M/D/1 server is already three services long."""
MACHINE_BUSY = 0.95
OTHERS = 0.3
"""Cores used by other processes above which a run is not that of an idle machine."""
LAG_MS = 20.0
"""Lateness of the generator's event loop above which its own delays are what is measured."""


@dataclass(frozen=True)
class Resources:
    """How busy everything was, as shares of what it has (0..1), and how late the generator was.

    ``server_loop``: the server's event loop, of one core; ``workers``: the server's other threads,
    of the cores they can have; ``link``: the busiest vehicle's uplink; ``generator``: the busiest
    process that plays vehicles or links, of one core (0 for live vehicles: they are what is
    tested). ``machine``: all cores, of which the test's own processes used the share ``test``, and
    others ``others`` cores.
    """

    server_loop: float
    workers: float
    link: float
    generator: float
    machine: float
    test: float
    others: float
    generator_lag_ms: float


@dataclass(frozen=True)
class Use:
    """Utilisation of one resource, its limit, and both in words."""

    text: str
    share: float
    limit: float

    @property
    def is_over(self) -> bool:
        """Whether work queued up for it."""
        return self.share > self.limit


def limit(resources: Resources) -> str:
    """Name the first resource that was at its limit and its use, else the one nearest to it."""
    r = resources
    machine = Use(
        f"CPU of the machine, at {_percent(r.machine)}{_beside(r)}", r.machine, MACHINE_BUSY
    )
    uses = (_lag(r), *_on_one_core(r), machine, _workers(r))
    over = next((use for use in uses if use.is_over), None)
    return over.text if over is not None else f"nearest: {_fullest(uses)}"


def nearest(resources: Resources) -> str:
    """Name the resource that a load which was held would break first, and its use.

    What other processes use of the machine is left out, since they are no part of the test.
    """
    r = resources
    machine = Use(f"CPU of the machine, at {_percent(r.test)}", r.test, MACHINE_BUSY)
    return f"nearest: {_fullest((*_on_one_core(r), machine, _workers(r)))}"


def _fullest(uses: Sequence[Use]) -> str:
    return max(uses, key=lambda use: use.share / use.limit).text


def _on_one_core(r: Resources) -> tuple[Use, ...]:
    return (
        Use(f"vehicles of the test, at {_percent(r.generator)} of a core", r.generator, BUSY),
        Use(f"link of the busiest vehicle, at {_percent(r.link)}", r.link, BUSY),
        Use(f"server's event loop, at {_percent(r.server_loop)} of a core", r.server_loop, BUSY),
    )


def _workers(r: Resources) -> Use:
    return Use(f"server's workers, at {_percent(r.workers)}", r.workers, BUSY)


def _lag(r: Resources) -> Use:
    """Lateness of the generator, unless the whole machine was busy."""
    late = r.generator_lag_ms if r.machine < MACHINE_BUSY else 0.0
    return Use(f"vehicles of the test, {late:.0f} ms late themselves", late, LAG_MS)


def _beside(r: Resources) -> str:
    return f", {r.others:.1f} cores of it by others" if r.others > OTHERS else ""


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


CONFIDENCE = 0.95


@dataclass(frozen=True)
class VehicleCount:
    """One vehicle's pictures: how many were due and on time, and latencies of the acknowledged."""

    due: int
    on_time: int
    latency_ms: Sequence[float]


@dataclass(frozen=True)
class Measured:
    """What is judged of one run. ``growth_mb``: of the server's memory, over ``minutes``."""

    vehicles: Sequence[VehicleCount]
    wanted_vehicles: int
    growth_mb: float
    minutes: float
    resources: Resources


@dataclass(frozen=True)
class Verdict:
    """``broken``: the bounds that were not kept; none means held."""

    broken: Sequence[str]
    p50_ms: float
    p99_ms: float
    on_time_percent: float
    on_time_at_least_percent: float
    fairness: float
    limited_by: str

    @property
    def held(self) -> bool:
        """Whether every bound was kept."""
        return not self.broken


def judge(measured: Measured, bounds: Bounds) -> Verdict:
    """Compare a run with its bounds."""
    due = sum(vehicle.due for vehicle in measured.vehicles)
    on_time = sum(vehicle.on_time for vehicle in measured.vehicles)
    latency_ms = [ms for vehicle in measured.vehicles for ms in vehicle.latency_ms]
    p50_ms, p99_ms = _percentiles(latency_ms)
    percent = 100.0 * on_time / due if due else 0.0
    fairness = _fairness(measured.vehicles)
    allowed_mb = bounds.settling_mb + bounds.growth_mb_per_minute * measured.minutes
    checks = (
        (
            len(measured.vehicles) < measured.wanted_vehicles,
            f"{measured.wanted_vehicles - len(measured.vehicles)} vehicles were not admitted",
        ),
        (p99_ms > bounds.deadline_ms, f"p99 {p99_ms:.0f} ms above {bounds.deadline_ms:g} ms"),
        (
            percent < bounds.on_time_percent,
            f"{percent:.2f} % on time, below {bounds.on_time_percent:g} %",
        ),
        (fairness < bounds.fairness, f"fairness {fairness:.2f} below {bounds.fairness:g}"),
        (
            measured.growth_mb > allowed_mb,
            f"memory grew {measured.growth_mb:.1f} MB, {allowed_mb:.1f} may be",
        ),
    )
    broken = tuple(problem for is_broken, problem in checks if is_broken)
    return Verdict(
        broken=broken,
        p50_ms=p50_ms,
        p99_ms=p99_ms,
        on_time_percent=percent,
        on_time_at_least_percent=100.0 * share_at_least(on_time, due),
        fairness=fairness,
        limited_by=(limit if broken else nearest)(measured.resources),
    )


def share_at_least(successes: int, trials: int) -> float:
    """Return the lower end of Wilson's 95 % interval of a share; 0 without trials.

    Frames of one vehicle are late together, so the true interval is wider.
    """
    if not trials:
        return 0.0
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low)


def _percentiles(latency_ms: Sequence[float]) -> tuple[float, float]:
    """Return the 50th and the 99th; of nothing, infinity."""
    if not latency_ms:
        return math.inf, math.inf
    p50_ms, p99_ms = np.percentile(np.array(latency_ms), (50, 99))
    return float(p50_ms), float(p99_ms)


def _fairness(vehicles: Sequence[VehicleCount]) -> float:
    """Return the worst vehicle's share on time over the best one's."""
    shares = [vehicle.on_time / vehicle.due for vehicle in vehicles if vehicle.due]
    best = max(shares, default=0.0)
    return min(shares) / best if best else 0.0
