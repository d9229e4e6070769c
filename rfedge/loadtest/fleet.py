"""The fleet of prerecorded vehicles: one process, one stream (and connection) a vehicle.

``python -m rfedge.loadtest.fleet SPEC RESULT``: both are JSON. All vehicles connect before the
first picture is due. Their pictures are due at times spread evenly over a period, as if the
vehicles knew nothing of each other.

A ``PrerecordedVehicle`` does everything in callbacks of the event loop (bytes arrived, a picture is
due), without a task or a future for each frame, so that one process plays a hundred vehicles in
half a core.
"""

from __future__ import annotations

import asyncio
import json
import ssl
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import grpc

from rfcore.errors import ProtocolError
from rfcore.files import write_whole
from rfcore.wire.conventions import STREAM_METHOD
from rfcore.wire.convert import hello_to_bytes
from rfcore.wire.convert_answers import AnswerReader
from rfcore.wire.head import FrameWriter
from rfcore.wire.messages import Hello, Welcome
from rfcore.wire.notices import StreetNotice
from rfedge.loadtest.grpc_call import GrpcCall, Status
from rfedge.loadtest.prerecorded import End, PrerecordedDrive, Replay, Schedule

_EPOCH_NS = time.time_ns() - time.monotonic_ns()
CODES = {code.value[0]: code.name for code in grpc.StatusCode}


class PrerecordedVehicle(asyncio.Protocol):
    """A vehicle that replays a drive for each of its cameras.

    ``met`` is set when the server has answered Hello, ``over`` when nothing more will happen.
    ``refused`` and ``failed`` say why the server did not admit the vehicle or why its stream was
    lost. ``tls`` has the vehicle's certificate and ALPN for HTTP/2; None: no TLS. ``on_notice`` is
    called with the notices of the server, if the Hello asks for them.
    """

    def __init__(
        self,
        name: str,
        address: str,
        hello: Hello,
        drive: PrerecordedDrive,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self.refused = ""
        self.failed = ""
        self.granted_hz = 0.0
        self.met = asyncio.Event()
        self.over = asyncio.Event()
        self.on_notice: Callable[[StreetNotice], None] = lambda _: None
        self._address, self._tls = address, tls
        self._hello = replace(hello, vehicle_id=name)
        writer = FrameWriter(self._hello)
        self._answers = AnswerReader(camera.camera_id for camera in hello.cameras)
        self.replays = [Replay(c.camera_id, drive, wall_ns, writer) for c in hello.cameras]
        self._call = GrpcCall(address, STREAM_METHOD)
        self._transport: asyncio.Transport | None = None
        self._alarm: asyncio.TimerHandle | None = None
        self._is_full = False
        self._departed = False

    async def connect(self, within_s: float, source: str = "") -> None:
        """Say Hello and wait for the answer; a problem is in ``refused`` or ``failed``.

        ``source`` is the local address; without one the kernel chooses.
        """
        host, port = self._address.rsplit(":", 1)
        try:
            async with asyncio.timeout(within_s):
                loop = asyncio.get_running_loop()
                own = (source, 0) if source else None
                await loop.create_connection(
                    lambda: self, host, int(port), ssl=self._tls, local_addr=own
                )
                await self.met.wait()
        except TimeoutError:
            self._fail(f"no Welcome within {within_s:g} s")
        except OSError as error:
            self._fail(f"{self._address}: {error}")

    def depart(self, schedule: Schedule, give_up_s: float) -> None:
        """Send pictures by ``schedule``; those not answered by ``give_up_s`` stay open."""
        if 0 < self.granted_hz < schedule.hz:
            schedule = replace(schedule, hz=self.granted_hz)
        if self.refused:
            self.over.set()
            return
        self._departed = True
        for replay in self.replays:
            replay.begin(schedule)
        if self.failed:
            self.leave()
            return
        asyncio.get_running_loop().call_at(give_up_s, self.leave)
        self._go_on()

    def leave(self) -> None:
        """Close the connection, and drop the pictures that were still to come."""
        if self.over.is_set():
            return
        for replay in self.replays:
            replay.give_up()
        self.over.set()
        if self._alarm is not None:
            self._alarm.cancel()
        if self._transport is not None:
            self._transport.abort()

    # --- asyncio.Protocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Say Hello."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._call.send(hello_to_bytes(self._hello))
        self._flush()

    def data_received(self, data: bytes) -> None:
        """Take answers, and send the frames that waited for them."""
        now, was_blocked = time.monotonic(), self._call.is_blocked
        try:
            for part in self._call.receive(data):
                self._take(part, now)
        except ProtocolError as error:
            self._fail(str(error))
        if self._call.status is not None:
            self._end(self._call.status)
        if was_blocked or any(replay.is_ready or replay.is_idle for replay in self.replays):
            self._go_on()
        else:
            self._flush()

    def connection_lost(self, exc: Exception | None) -> None:
        """Note that the connection is lost."""
        if not self.over.is_set() and not self.refused:
            self._fail(f"connection lost: {exc or 'closed by the server'}")

    def pause_writing(self) -> None:
        """Stop writing: the socket's buffer is full."""
        self._is_full = True

    def resume_writing(self) -> None:
        """Go on writing: the socket's buffer has room."""
        self._is_full = False
        self._go_on()

    def _take(self, data: bytes, now: float) -> None:
        for message in self._answers.messages(data):
            for replay in self.replays:
                replay.receive(message, now)
            if isinstance(message, StreetNotice):
                self.on_notice(message)
            elif isinstance(message, Welcome):
                self.granted_hz = message.rate_hz
                self.met.set()

    def _go_on(self) -> None:
        """Send the frames that are due and have credit, and set the timer for the next one."""
        if self.over.is_set():
            return
        now = time.monotonic()
        for replay in self.replays if self._departed else ():
            if self._is_full or self._call.is_blocked:
                break
            message = replay.frame_to_send(now)
            if message is not None:
                self._call.send(message)
        self._flush()
        if self._departed:
            self._set_alarm()

    def _set_alarm(self) -> None:
        """Set the timer for the next picture, unless the server has to read first."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None
        if self._is_full or self._call.is_blocked:
            return
        timers = [timer for replay in self.replays if (timer := replay.get_timer()) is not None]
        if timers:
            self._alarm = asyncio.get_running_loop().call_at(min(timers), self._due)
        elif all(replay.is_idle for replay in self.replays):
            self.leave()

    def _due(self) -> None:
        self._alarm = None
        self._go_on()

    def _flush(self) -> None:
        data = self._call.data_to_send()
        if data and self._transport is not None:
            self._transport.write(data)

    def _end(self, status: Status) -> None:
        problem = f"{CODES.get(status.code, status.code)}: {status.details}"
        if status.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0] and not self.met.is_set():
            self.refused = problem
            self.met.set()
        else:
            self._fail(problem if status.code else "the server ended the stream")

    def _fail(self, problem: str) -> None:
        self.failed = self.failed or problem
        self.met.set()
        if self._departed:
            self.leave()


def wall_ns(moment_s: float) -> int:
    """Return the Unix time of a moment on the monotonic clock."""
    return _EPOCH_NS + round(moment_s * 1e9)


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
