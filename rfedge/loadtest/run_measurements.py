"""What one run brought home, from processes and files, as what ``verdict`` judges."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from rfedge.loadtest.plan import Load, Vehicles
from rfedge.loadtest.usage import Usage
from rfedge.loadtest.verdict import Measured, Resources, VehicleCount

__all__ = ["RunMeasurements", "VehicleReport", "links_busy", "measured"]


@dataclass(frozen=True)
class VehicleReport:
    """One vehicle: pictures due in the counted part, latencies of those acked, how many the server
    refused; the rate it was granted (0: any); why it was kept out (``refused``) or fell out
    (``failed``)."""

    due: int
    latency_ms: Sequence[float]
    nacked: int = 0
    granted_hz: float = 0.0
    refused: str = ""
    failed: str = ""


@dataclass(frozen=True)
class RunMeasurements:
    """What the vehicles report, and what the processes used meanwhile.

    ``generator_lag_ms``: 99th percentile of how late the fleet's event loop was.
    """

    vehicles: Sequence[VehicleReport]
    generator_lag_ms: float
    usage: Mapping[str, Usage]
    machine_busy: float
    hz: float

    @property
    def others_cores(self) -> float:
        """Cores that processes used which are not part of the test."""
        ours = sum(usage.cores for usage in self.usage.values())
        return max(0.0, self.machine_busy * (psutil.cpu_count() or 1) - ours)

    def row(self) -> dict[str, Any]:
        """Return what a result's row says of resources, in cores."""
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


def measured(load: Load, brought: RunMeasurements, link_busy: float, workers: int) -> Measured:
    """Return what is judged: vehicles that were let in, and how busy everything was."""
    deadline_ms = load.bounds.deadline_ms
    counts = [
        VehicleCount(v.due, sum(ms <= deadline_ms for ms in v.latency_ms), v.latency_ms)
        for v in brought.vehicles
        if not v.refused
    ]
    server = brought.usage["server"]
    is_canned = load.kind is Vehicles.CANNED
    players = ["vehicles", "links"] if is_canned else ["links"]
    generator = max((brought.usage[n].loop_cores for n in players if n in brought.usage), default=0)
    resources = Resources(
        server_loop=server.loop_cores,
        workers=(server.cores - server.loop_cores) / min(workers, psutil.cpu_count() or 1),
        link=link_busy,
        generator=generator,
        machine=brought.machine_busy,
        test=brought.machine_busy - brought.others_cores / (psutil.cpu_count() or 1),
        others=brought.others_cores,
        generator_lag_ms=brought.generator_lag_ms,
    )
    wanted = len(counts) if load.admission else load.vehicles
    return Measured(counts, wanted, server.growth_mb, server.minutes, resources)


def links_busy(report: Path, load: Load) -> float:
    """Return the share of the time that the busiest vehicle's uplink transmitted."""
    links = [json.loads(line) for line in report.read_text().splitlines()]
    seconds = load.warm_up_s + load.duration_s
    return max(float(link["uplink"]["expected_s"]) for link in links) / seconds
