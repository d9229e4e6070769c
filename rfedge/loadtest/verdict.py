"""Whether a load was held.

A frame is on time when its Ack was back within the deadline, counted from the moment the picture
was due. Frames that were dropped, refused or unanswered were not on time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rfedge.loadtest.limit import Resources, limit, nearest
from rfedge.loadtest.plan import Bounds

__all__ = ["Measured", "VehicleCount", "Verdict", "judge", "wilson_lower"]

Z95 = 1.959963984540054


@dataclass(frozen=True)
class VehicleCount:
    """One vehicle's pictures: how many were due, how many on time, the latencies of those acked."""

    due: int
    on_time: int
    latency_ms: Sequence[float]


@dataclass(frozen=True)
class Measured:
    """What one run brought. ``growth_mb``: of the server's memory, over ``minutes``."""

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
        on_time_at_least_percent=100.0 * wilson_lower(on_time, due),
        fairness=fairness,
        limited_by=(limit if broken else nearest)(measured.resources),
    )


def wilson_lower(successes: int, trials: int, z: float = Z95) -> float:
    """Return the lower end of Wilson's 95 % interval of a share (Wilson 1927).

    Frames of one vehicle are late together, so the true interval is wider.
    """
    if not trials:
        return 0.0
    share = successes / trials
    centre = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    return max(0.0, (centre - spread) / (1 + z * z / trials))


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
