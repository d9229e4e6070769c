"""The fleet of prerecorded vehicles: one process, one stream (and connection) a vehicle.

``python -m rfedge.loadtest.fleet SPEC RESULT``: both are JSON. All vehicles connect before the
first picture is due. Their pictures are due at times spread evenly over a period, as if the
vehicles knew nothing of each other.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rfcore.files import write_whole
from rfcore.wire.messages import Hello
from rfedge.loadtest.prerecorded import End, PrerecordedDrive, Schedule
from rfedge.loadtest.vehicle import PrerecordedVehicle

__all__ = ["FleetSpec", "main", "run_fleet"]

CONNECT_S = 20.0
DRAIN_S = 3.0
SETTLE_S = 0.2


@dataclass(frozen=True)
class FleetSpec:
    """The vehicles of a fleet, with the fields of ``Load`` that concern them."""

    addresses: tuple[str, ...]
    """The server's or link's HOST:PORT for each vehicle."""
    hz: float
    cameras: int
    warm_up_s: float
    duration_s: float
    ready_s: float
    """Time from the moment a picture is due until it is ready to send."""
    drive: str
    """Folder of a prerecorded drive."""


@dataclass(frozen=True)
class Departure:
    """The start of the whole fleet, and how its pictures are spread over a period.

    Pictures of vehicle i are due i / N of a period later. In the first half of the warm-up all are
    due together, so that every worker of the server renders and allocates its scratch memory
    (40 MB) before the measurement begins.
    """

    start_s: float
    vehicles: int
    spec: FleetSpec

    def schedule(self, vehicle: int) -> Schedule:
        """Return the schedule of a vehicle."""
        spec = self.spec
        later_s = vehicle / self.vehicles / spec.hz
        end_s = self.start_s + later_s + spec.warm_up_s + spec.duration_s
        together_s = spec.warm_up_s / 2
        return Schedule(self.start_s, end_s, spec.hz, spec.ready_s, together_s, later_s)


def _hello(spec: FleetSpec, drive: PrerecordedDrive) -> Hello:
    camera = drive.hello.cameras[0]
    several = (
        replace(camera, camera_id=f"{camera.camera_id}-{i}", rate_hz=spec.hz)
        for i in range(spec.cameras)
    )
    return replace(drive.hello, cameras=tuple(several))


class LagProbe:
    """Measures how late this process's event loop is, by sleeps of 10 ms that take longer."""

    PERIOD_S = 0.01

    def __init__(self) -> None:
        self.late_s: list[float] = []

    async def run(self) -> None:
        """Probe for ever."""
        while True:
            due_s = time.monotonic() + self.PERIOD_S
            await asyncio.sleep(self.PERIOD_S)
            self.late_s.append(time.monotonic() - due_s)

    def p99_ms(self) -> float:
        """Return the 99th percentile."""
        late_s = sorted(self.late_s)
        return 1e3 * late_s[int(0.99 * (len(late_s) - 1))] if late_s else 0.0


async def run_fleet(spec: FleetSpec, started: Callable[[], None]) -> dict[str, Any]:
    """Drive all vehicles; ``started`` is called when the counted part begins."""
    drive = PrerecordedDrive.read(Path(spec.drive))
    hello = _hello(spec, drive)
    vehicles = [
        PrerecordedVehicle(f"prerecorded-{i}", address, hello, drive)
        for i, address in enumerate(spec.addresses)
    ]
    await asyncio.gather(*(vehicle.connect(CONNECT_S) for vehicle in vehicles))
    departure = Departure(time.monotonic() + SETTLE_S, len(vehicles), spec)
    for i, vehicle in enumerate(vehicles):
        schedule = departure.schedule(i)
        vehicle.depart(schedule, schedule.end_s + DRAIN_S)
    await asyncio.sleep(SETTLE_S + spec.warm_up_s)
    started()
    probe = LagProbe()
    probing = asyncio.create_task(probe.run())
    await asyncio.gather(*(vehicle.over.wait() for vehicle in vehicles))
    probing.cancel()
    counted_s = departure.start_s + spec.warm_up_s
    return {
        "lag_p99_ms": probe.p99_ms(),
        "vehicles": [_vehicle_result(vehicle, counted_s) for vehicle in vehicles],
    }


def _vehicle_result(vehicle: PrerecordedVehicle, counted_s: float) -> dict[str, Any]:
    shots = [shot for r in vehicle.replays for shot in r.shots if shot.due_s >= counted_s]
    latencies_s = [shot.latency_s for shot in shots]
    return {
        "refused": vehicle.refused,
        "failed": vehicle.failed,
        "granted_hz": vehicle.granted_hz,
        "due": len(shots),
        "nacked": sum(shot.end is End.NACKED for shot in shots),
        "latency_ms": [1e3 * latency_s for latency_s in latencies_s if latency_s is not None],
    }


def main(arguments: Sequence[str]) -> None:
    """Read the spec, drive, write the result; touch RESULT.started when counting begins."""
    spec_path, result_path = map(Path, arguments)
    spec = FleetSpec(**json.loads(spec_path.read_text()))
    started = result_path.with_suffix(".started")
    result = asyncio.run(run_fleet(spec, lambda: write_whole(started, "")))
    write_whole(result_path, json.dumps(result))


if __name__ == "__main__":
    main(sys.argv[1:])
