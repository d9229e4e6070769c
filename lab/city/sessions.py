"""The flow model checked: the product's own sessions of sampled servers, on a virtual clock.

A sample is one server in one minute, with all its cells and their vehicles as the plan has them,
rounded to whole ones. Every vehicle is a ``cav_agent.session``, with the agent's schedule of
captures; every stream a ``mec_server.session`` with its account at the server's ledger and
promises; messages are the bytes of the wire; cells are ``rfcore.link`` links of their rates. Not
theirs are the times that coding and reconstruction take, which are the tables', and the sockets,
which there are none of. Vehicles come and go as often as the plan says, each leaving for one that
comes, which fetches as much of a field as the mean vehicle lacks.

Everything happens at moments of one queue of events: the same seed gives the same figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import count

import numpy as np

from cav_agent.capture_schedule import Realtime
from cav_agent.frames import Capture, EncodedFrame, EncodeJob, EndReason, StreamEnd
from cav_agent.session import AgentSession, LinkState
from lab.city.city import City
from lab.city.flow import Costs
from lab.city.virtual_server import (
    DIGEST,
    FIELD_ID,
    Events,
    Pipe,
    ServerStream,
    VirtualServer,
)
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import LimitExceeded, RfedgeError
from rfcore.image import Rgb
from rfcore.views import PosedPicture
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.convert import client_message_to_bytes
from rfcore.wire.convert_answers import server_messages_from_bytes
from rfcore.wire.messages import CameraDescription, Frame, Hello, RendererContract

__all__ = ["SampledServer", "SessionFigures", "run_sessions"]

RECONNECT_S = 0.1
CHUNK_BYTES = 256 << 10
"""A field is fetched in pieces of so many bytes, each when the one before has arrived."""
START_WITHIN_S = 2.0


@dataclass(frozen=True)
class SampledServer:
    """A server with the vehicles and entries per second of each of its cells (by their numbers)."""

    server: int
    vehicles: dict[int, int]
    entries_per_s: dict[int, float]


@dataclass(frozen=True)
class SessionFigures:
    """The figures that were counted; rates are per second of the counted time.

    ``sent_bytes``, ``delivered_bytes`` and ``held_bytes`` are of the uplinks over the whole run.
    """

    served: float
    pictures_per_s: float
    uplink_bps: float
    downlink_bps: float
    cores: float
    ages_s: tuple[float, ...]
    sent_bytes: int
    delivered_bytes: int
    held_bytes: int


def run_sessions(
    city: City, costs: Costs, sampled: SampledServer, warm_up_s: float, counted_s: float
) -> SessionFigures:
    """Run a sampled server from nobody to the end of the counted time, and return its figures."""
    run = SessionRun(city, costs, sampled)
    run.events.run_until(warm_up_s)
    run.begin_counting()
    run.events.run_until(warm_up_s + counted_s)
    return run.figures(counted_s)


@dataclass(frozen=True)
class RadioCell:
    """The links and the server that the vehicles of one cell share."""

    uplink: Pipe
    downlink: Pipe
    server: VirtualServer
    overhead: float
    retry_s: float


class VirtualVehicle:
    """An agent with its schedule, its coder's times and its stream."""

    def __init__(self, name: str, cell: RadioCell, hello: Hello, first_frame: int) -> None:
        self.is_gone = False
        self._name, self._radio_cell, self._hello = name, cell, hello
        self._costs, self._events = cell.server.costs, cell.server.events
        self._agent = AgentSession(hello)
        self._schedule = Realtime(1 << 40, self._costs.hz, loop=True)
        self._stream: ServerStream | None = None
        self._streams = count()
        self._frames = first_frame
        self._sequence: dict[str, tuple[int, int]] = {}
        self._instant = 0
        self._begun: tuple[int, float] = (0, 0.0)

    @property
    def is_streaming(self) -> bool:
        """Whether a server has welcomed it."""
        return not self.is_gone and self._agent.state is LinkState.STREAMING

    def arrive(self, fetched_bytes: float = 0.0) -> None:
        """Fetch so many bytes of a field, then stream."""
        if fetched_bytes > 0:
            self._fetch(fetched_bytes)
            return
        self._connect()
        self._tick()

    def leave(self) -> None:
        """Be gone, with whatever is under way."""
        self.is_gone = True
        if self._stream is not None:
            self._stream.close()

    def _fetch(self, left_bytes: float) -> None:
        if self.is_gone:
            return
        if left_bytes <= 0:
            self.arrive()
            return
        size_bytes = min(CHUNK_BYTES, int(left_bytes) + 1)
        size_on_link = round(size_bytes * self._radio_cell.overhead)
        self._radio_cell.downlink.send(size_on_link, lambda: self._fetch(left_bytes - size_bytes))

    def _connect(self) -> None:
        if self.is_gone:
            return
        name = f"{self._name}/{next(self._streams)}"
        self._agent.connected(self._events.now)
        try:
            self._stream = ServerStream(self._radio_cell.server, name, self._answer, self._refused)
        except LimitExceeded:
            self._refused()
            return
        self._pump()

    def _answer(self, data: bytes) -> None:
        """Send an answer down to this vehicle; one of an earlier stream is nobody's."""
        stream = self._stream
        size_bytes = round(len(data) * self._radio_cell.overhead)

        def arrive() -> None:
            if stream is self._stream and not self.is_gone:
                for message in server_messages_from_bytes(data):
                    self._agent.receive(message, self._events.now)
                self._schedule.limit(self._agent.rate_limit_hz)
                self._pump()

        self._radio_cell.downlink.send(size_bytes, arrive)

    def _refused(self) -> None:
        """The server has no room: come again when it says."""
        self._stream = None
        self._agent.connection_lost(StreamEnd(EndReason.STREAM_LOST, "refused"), self._events.now)
        self._events.after(self._radio_cell.retry_s, self._connect)

    def _tick(self) -> None:
        if self.is_gone:
            return
        now = self._events.now
        self._agent.handle_timer(now)
        if self._agent.broken is not None:
            self._break(self._agent.broken)
        if self._schedule.next_capture(now) is not None:
            self._instant += 1
            self._agent.offer(*(self._capture(camera) for camera in self._hello.cameras))
        self._pump()
        timer_s = self._schedule.get_timer()
        assert timer_s is not None
        self._events.at(timer_s, self._tick)

    def _break(self, end: StreamEnd) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        self._agent.connection_lost(end, self._events.now)
        self._agent.broken = None
        self._events.after(RECONNECT_S, self._connect)

    def _capture(self, camera: CameraDescription) -> Capture:
        now = self._events.now
        posed = PosedPicture("", Camera(camera.intrinsics, Pose.identity()), _no_picture)
        time_ns = round(1e9 * now)
        return Capture(camera.camera_id, self._instant, posed, now, time_ns, instant=self._instant)

    def _pump(self) -> None:
        job = self._agent.job_to_start(self._events.now)
        if job is not None:
            self._encode(job)
        stream = self._stream
        for outgoing in self._agent.messages_to_send(self._events.now):
            size_bytes = round(len(outgoing.data) * self._radio_cell.overhead)
            if stream is not None:
                self._radio_cell.uplink.send(size_bytes, partial(stream.receive, outgoing.data))
        self._agent.take_results()

    def _encode(self, job: EncodeJob) -> None:
        """The cameras of an instant are coded at the same time, as ``rfedge size`` takes it."""
        now, instant = self._events.now, job.capture.instant
        if self._begun[0] != instant:
            self._begun = instant, now
        self._events.at(self._begun[1] + self._costs.sender_s, partial(self._encoded, job))

    def _encoded(self, job: EncodeJob) -> None:
        if self.is_gone:
            return
        camera_id = job.capture.camera_id
        epoch, last = self._sequence.get(camera_id, (-1, -1))
        sequence = last + 1 if epoch == job.epoch else 0
        self._sequence[camera_id] = job.epoch, sequence
        payload = bytes(self._payload_bytes(job))
        packet = DeltaPacket(job.epoch, sequence, DIGEST, b"", DIGEST, payload, 0).sealed()
        coded = EncodedFrame(packet, {"encode": self._costs.sender_s}, Pose.identity())
        self._agent.encoded(coded, self._events.now)
        self._pump()

    def _payload_bytes(self, job: EncodeJob) -> int:
        costs = self._costs
        ratio = costs.frame_ratios[self._frames % len(costs.frame_ratios)]
        self._frames += 1
        if job.base is None:
            ratio *= costs.first_frame_ratio
        message_bytes = costs.frame_bytes / self._radio_cell.overhead * ratio
        return max(1, round(message_bytes) - HEADER_BYTES)


def _no_picture() -> Rgb:
    raise RfedgeError("vehicles on the virtual clock code no pictures")


def _header_bytes() -> int:
    packet = DeltaPacket(0, 0, DIGEST, b"", DIGEST, bytes(1000), 0).sealed()
    frame = Frame("camera-0", 10**10, Pose.identity(), bytes(8), packet)
    return len(client_message_to_bytes(frame)) - 1000


HEADER_BYTES = _header_bytes()
"""Bytes of a frame's message beside its payload."""


class SessionRun:
    """A sampled server and everybody in its cells."""

    def __init__(self, city: City, costs: Costs, sampled: SampledServer) -> None:
        self.events = Events()
        self._random = np.random.default_rng([city.seed, sampled.server])
        self._fetched_bytes = city.tile.field_bytes * (1 - city.tile.known_share)
        cores = int(city.servers.cores[sampled.server])
        self._server = VirtualServer(city, costs, cores, self.events)
        self._hello = _hello(city)
        self._costs = costs
        self._names = count()
        self._radio_cells = {cell: self._radio_cell(city, cell) for cell in sampled.vehicles}
        self._vehicles: dict[int, list[VirtualVehicle]] = {cell: [] for cell in sampled.vehicles}
        for cell, vehicles in sampled.vehicles.items():
            for _ in range(vehicles):
                self._begin(cell, self._random.uniform(0, START_WITHIN_S))
            self._exchange(cell, sampled.entries_per_s.get(cell, 0.0))
        self.events.at(0.5, self._look)

    def _radio_cell(self, city: City, cell: int) -> RadioCell:
        delay_s, cells = self._costs.propagation_s, city.cells
        return RadioCell(
            uplink=Pipe(self.events, float(cells.uplink_bps[cell]), delay_s),
            downlink=Pipe(self.events, float(cells.downlink_bps[cell]), delay_s),
            server=self._server,
            overhead=1 + city.assumptions.overhead_percent / 100,
            retry_s=city.admission.limits.retry_s,
        )

    def _begin(self, cell: int, at_s: float, fetched_bytes: float = 0.0) -> None:
        first = int(self._random.integers(1 << 30))
        name = f"cav-{next(self._names)}"
        hello = replace(self._hello, vehicle_id=name)
        vehicle = VirtualVehicle(name, self._radio_cells[cell], hello, first)
        self._vehicles[cell].append(vehicle)
        self.events.at(at_s, lambda: vehicle.arrive(fetched_bytes))

    def _exchange(self, cell: int, entries_per_s: float) -> None:
        """Let the vehicle that is there for longest leave for another, again and again."""
        if entries_per_s <= 0 or not self._vehicles[cell]:
            return

        def exchange() -> None:
            self._vehicles[cell].pop(0).leave()
            phase_s = self._random.uniform(0, 1 / self._costs.hz)
            self._begin(cell, self.events.now + phase_s, self._fetched_bytes)
            self.events.after(1 / entries_per_s, exchange)

        self.events.after(START_WITHIN_S + self._random.uniform(0, 1 / entries_per_s), exchange)

    def _look(self) -> None:
        if self._server.counted.on:
            there = (vehicle for cell in self._vehicles.values() for vehicle in cell)
            self._server.counted.served.append(sum(vehicle.is_streaming for vehicle in there))
        self.events.after(1.0, self._look)

    def _delivered(self) -> tuple[int, int]:
        cells = self._radio_cells.values()
        return (
            sum(cell.uplink.delivered_bytes for cell in cells),
            sum(cell.downlink.delivered_bytes for cell in cells),
        )

    def begin_counting(self) -> None:
        """Count from now on."""
        counted = self._server.counted
        counted.on = True
        counted.uplink_bytes, counted.downlink_bytes = self._delivered()

    def figures(self, counted_s: float) -> SessionFigures:
        """Return what was counted."""
        counted, uplinks = self._server.counted, [s.uplink for s in self._radio_cells.values()]
        up_bytes, down_bytes = self._delivered()
        return SessionFigures(
            served=float(np.mean(counted.served)) if counted.served else 0.0,
            pictures_per_s=len(counted.ages_s) / counted_s,
            uplink_bps=8 * (up_bytes - counted.uplink_bytes) / counted_s,
            downlink_bps=8 * (down_bytes - counted.downlink_bytes) / counted_s,
            cores=counted.busy_s / counted_s,
            ages_s=tuple(counted.ages_s),
            sent_bytes=sum(pipe.sent_bytes for pipe in uplinks),
            delivered_bytes=sum(pipe.delivered_bytes for pipe in uplinks),
            held_bytes=sum(pipe.held_bytes for pipe in uplinks),
        )


def _hello(city: City) -> Hello:
    demand = city.vehicle.demand
    width_px, height_px = demand.width_px, demand.height_px
    intrinsics = Intrinsics(
        width_px, height_px, width_px / 2, width_px / 2, width_px / 2, height_px / 2
    )
    header = StreamHeader(CodecConfig(width_px, height_px), b"\x67" * 20, b"\x68" * 5)
    cameras = tuple(
        CameraDescription(f"camera-{number}", intrinsics, header, demand.hz)
        for number in range(demand.cameras)
    )
    return Hello("cav", cameras, (FIELD_ID,), RendererContract(RENDERER_CONTRACT, exact=True))
