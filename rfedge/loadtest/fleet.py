"""The fleet of canned vehicles: one process, one stream (and connection) a vehicle.

``python -m rfedge.loadtest.fleet SPEC RESULT``: both are JSON. All vehicles connect before the
first picture is due; their pictures are due at times spread evenly over a period, as those of
vehicles that know nothing of each other.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import grpc

from rfcore.files import write_whole
from rfcore.wire.conventions import CHANNEL_OPTIONS, STREAM_METHOD
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.convert_answers import server_messages_from_bytes
from rfcore.wire.messages import Hello, Welcome
from rfedge.loadtest.canned import CannedDrive
from rfedge.loadtest.replay import End, Replay, Schedule

__all__ = ["FleetSpec", "main", "run_fleet"]

CONNECT_S = 20.0
DRAIN_S = 3.0
SETTLE_S = 0.2

Stream = grpc.aio.StreamStreamCall[bytes, bytes]


@dataclass(frozen=True)
class FleetSpec:
    """Where each vehicle connects, what it sends, and when.

    ``drive``: the folder of a canned drive.
    """

    addresses: tuple[str, ...]
    hz: float
    cameras: int
    warm_up_s: float
    duration_s: float
    ready_s: float
    drive: str


@dataclass(frozen=True)
class Departure:
    """When the whole fleet starts: vehicle i a share i / N of a period later."""

    start_s: float
    vehicles: int
    spec: FleetSpec

    def schedule(self, vehicle: int) -> Schedule:
        """Return the schedule of a vehicle."""
        spec = self.spec
        start_s = self.start_s + vehicle / self.vehicles / spec.hz
        end_s = start_s + spec.warm_up_s + spec.duration_s
        return Schedule(start_s, end_s, spec.hz, spec.ready_s)


class CannedVehicle:
    """One vehicle on one stream."""

    def __init__(self, number: int, spec: FleetSpec, drive: CannedDrive) -> None:
        self.name = f"canned-{number}"
        self.refused = ""
        self.failed = ""
        self.granted_hz = 0.0
        self._number = number
        self._address = spec.addresses[number]
        self._hello = _hello(drive, self.name, spec.cameras, spec.hz)
        cameras = [camera.camera_id for camera in self._hello.cameras]
        self.replays = [Replay(name, drive, _wall_ns) for name in cameras]
        self._met = asyncio.Event()
        self._wake = asyncio.Event()

    async def met(self) -> None:
        """Wait until the server has welcomed or refused this vehicle, or cannot be reached."""
        with suppress(TimeoutError):
            async with asyncio.timeout(CONNECT_S):
                await self._met.wait()
                return
        self.failed = f"no Welcome within {CONNECT_S:g} s"

    async def run(self, departure: asyncio.Future[Departure]) -> None:
        """Connect, say Hello, wait for the departure, then replay to the end."""
        async with grpc.aio.insecure_channel(self._address, options=CHANNEL_OPTIONS) as channel:
            stream: Stream = channel.stream_stream(STREAM_METHOD)()
            reading = asyncio.create_task(self._read(stream))
            try:
                with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):
                    await stream.write(client_message_to_bytes(self._hello))
                schedule = (await departure).schedule(self._number)
                if 0 < self.granted_hz < schedule.hz:
                    schedule = replace(schedule, hz=self.granted_hz)
                if not self.refused:
                    for replay in self.replays:
                        replay.begin(schedule)
                    await self._replay(stream, schedule.end_s + DRAIN_S)
            finally:
                reading.cancel()
                stream.cancel()
                await asyncio.gather(reading, return_exceptions=True)

    async def _read(self, stream: Stream) -> None:
        try:
            async for data in stream:
                now = time.monotonic()
                for message in server_messages_from_bytes(data):
                    for replay in self.replays:
                        replay.receive(message, now)
                    if isinstance(message, Welcome):
                        self.granted_hz = message.rate_hz
                        self._met.set()
                if any(replay.is_ready or replay.is_idle for replay in self.replays):
                    self._wake.set()
            self.failed = "the server ended the stream"
        except grpc.aio.AioRpcError as error:
            self._lost(error)
        self._met.set()
        self._wake.set()

    def _lost(self, error: grpc.aio.AioRpcError) -> None:
        problem = f"{error.code().name}: {error.details()}"
        if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED and not self._met.is_set():
            self.refused = problem
        else:
            self.failed = problem

    async def _replay(self, stream: Stream, until_s: float) -> None:
        while not self.failed and (now := time.monotonic()) < until_s:
            await self._send(stream, now)
            if all(replay.is_idle for replay in self.replays):
                return
            timers = [replay.get_timer() for replay in self.replays]
            due_s = min((timer for timer in timers if timer is not None), default=until_s)
            alarm = asyncio.get_running_loop().call_at(due_s, self._wake.set)
            await self._wake.wait()
            self._wake.clear()
            alarm.cancel()
        for replay in self.replays:
            replay.give_up()

    async def _send(self, stream: Stream, now: float) -> None:
        for replay in self.replays:
            frame = replay.frame_to_send(now)
            if frame is not None:
                with suppress(grpc.aio.AioRpcError, asyncio.InvalidStateError):  # the reader tells
                    await stream.write(client_message_to_bytes(frame))


def _hello(drive: CannedDrive, name: str, cameras: int, hz: float) -> Hello:
    camera = drive.hello.cameras[0]
    several = (
        replace(camera, camera_id=f"{camera.camera_id}-{i}", rate_hz=hz) for i in range(cameras)
    )
    return replace(drive.hello, vehicle_id=name, cameras=tuple(several))


_EPOCH_NS = time.time_ns() - time.monotonic_ns()


def _wall_ns(moment_s: float) -> int:
    """Return the Unix time of a moment on the monotonic clock."""
    return _EPOCH_NS + round(moment_s * 1e9)


class LagProbe:
    """How late this process's own event loop is: sleeps of 10 ms that took longer."""

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
    drive = CannedDrive.read(Path(spec.drive))
    vehicles = [CannedVehicle(i, spec, drive) for i in range(len(spec.addresses))]
    departure: asyncio.Future[Departure] = asyncio.get_running_loop().create_future()
    probe = LagProbe()
    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(vehicle.run(departure)) for vehicle in vehicles]
        await asyncio.gather(*(vehicle.met() for vehicle in vehicles))
        start_s = time.monotonic() + SETTLE_S
        departure.set_result(Departure(start_s, len(vehicles), spec))
        await asyncio.sleep(SETTLE_S + spec.warm_up_s)
        started()
        probing = asyncio.create_task(probe.run())
        await asyncio.wait(running)
        probing.cancel()
    counted_s = start_s + spec.warm_up_s
    return {
        "lag_p99_ms": probe.p99_ms(),
        "vehicles": [_vehicle_result(vehicle, counted_s) for vehicle in vehicles],
    }


def _vehicle_result(vehicle: CannedVehicle, counted_s: float) -> dict[str, Any]:
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
