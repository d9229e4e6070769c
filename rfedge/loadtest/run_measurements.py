"""Measurements of one run, from processes and files, as what ``verdict`` judges."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.extras import needs
from rfedge.loadtest.plan import Load, Vehicles
from rfedge.loadtest.usage import Usage
from rfedge.loadtest.verdict import Measured, Resources, VehicleCount

with needs("loadtest"):
    import psutil

__all__ = ["RunMeasurements", "VehicleReport", "links_busy", "measured"]


@dataclass(frozen=True)
class VehicleReport:
    """One vehicle in the counted part of a run.

    ``due``: pictures that were due; ``latency_ms``: of those acknowledged; ``nacked``: how many the
    server refused; ``granted_hz``: the rate it admitted (0: any); ``refused``: why it did not admit
    the vehicle, ``failed``: why the vehicle lost its stream (both empty if it did not).
    """

    due: int
    latency_ms: Sequence[float]
    nacked: int = 0
    granted_hz: float = 0.0
    refused: str = ""
    failed: str = ""


@dataclass(frozen=True)
class RunMeasurements:
    """Reports of the vehicles, and use of the processes over the counted part.

    ``generator_lag_ms``: 99th percentile of how late the fleet's event loop was.
    """

    vehicles: Sequence[VehicleReport]
    generator_lag_ms: float
    usage: Mapping[str, Usage]
    machine_busy: float
    hz: float

    @property
    def others_cores(self) -> float:
        """Cores used by processes that are not part of the test."""
        ours = sum(usage.cores for usage in self.usage.values())
        return max(0.0, self.machine_busy * (psutil.cpu_count() or 1) - ours)

    def fields(self) -> dict[str, Any]:
        """Return the fields of ``LoadRow`` that count vehicles and resources."""
        cores = {name: usage.cores for name, usage in self.usage.items()}
        return {
            "refused": sum(bool(vehicle.refused) for vehicle in self.vehicles),
            "failed": sum(bool(vehicle.failed) for vehicle in self.vehicles),
            "reduced": sum(0 < vehicle.granted_hz < self.hz for vehicle in self.vehicles),
            "nacked": sum(vehicle.nacked for vehicle in self.vehicles),
            "server_cores": cores["server"],
            "server_loop_cores": self.usage["server"].loop_cores,
            "vehicles_cores": cores.get("vehicles", 0.0),
            "links_cores": cores.get("links", 0.0),
            "others_cores": self.others_cores,
            "server_growth_mb": self.usage["server"].growth_mb,
            "generator_lag_ms": self.generator_lag_ms,
        }


def measured(load: Load, run: RunMeasurements, link_busy: float, workers: int) -> Measured:
    """Return what is judged: the vehicles that were admitted, and how busy everything was."""
    deadline_ms = load.bounds.deadline_ms
    counts = [
        VehicleCount(v.due, sum(ms <= deadline_ms for ms in v.latency_ms), v.latency_ms)
        for v in run.vehicles
        if not v.refused
    ]
    server = run.usage["server"]
    prerecorded = load.kind is Vehicles.PRERECORDED
    generators = ["vehicles", "links"] if prerecorded else ["links"]
    generator = max((run.usage[n].loop_cores for n in generators if n in run.usage), default=0)
    resources = Resources(
        server_loop=server.loop_cores,
        workers=(server.cores - server.loop_cores) / min(workers, psutil.cpu_count() or 1),
        link=link_busy,
        generator=generator,
        machine=run.machine_busy,
        test=run.machine_busy - run.others_cores / (psutil.cpu_count() or 1),
        others=run.others_cores,
        generator_lag_ms=run.generator_lag_ms,
    )
    wanted = len(counts) if load.admission else load.vehicles
    return Measured(counts, wanted, server.growth_mb, server.minutes, resources)


def links_busy(report: Path, load: Load) -> float:
    """Return the share of the time that the busiest vehicle's uplink transmitted."""
    links = [json.loads(line) for line in report.read_text().splitlines()]
    seconds = load.warm_up_s + load.duration_s
    return max(float(link["uplink"]["expected_s"]) for link in links) / seconds
