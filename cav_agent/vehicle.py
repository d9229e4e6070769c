"""One vehicle: opens its drive, gets fields as it comes by, and streams to the servers there."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import grpc
import structlog
from prometheus_client import CollectorRegistry, start_http_server

from cav_agent.capture_schedule import CaptureSchedule
from cav_agent.client import Agent, Equipment
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.deadline import DeadlineController, DeadlineRungs, FixedRung, Rungs, Step
from cav_agent.field_fetch import WHOLE_STREET, fetch_field, published_tiles
from cav_agent.frame_log import FrameLog
from cav_agent.frames import FrameResult, Outcome
from cav_agent.handover import Cause, Stop
from cav_agent.handover_controller import HandoverController, Hooks
from cav_agent.metrics import AgentMetrics
from cav_agent.pipeline import Pipeline
from cav_agent.rate_control import QualitySteps, RateControl
from cav_agent.server_connection import ServerConnection
from cav_agent.session import AgentSession
from cav_agent.tile_stream import Ready
from rfcore.camera import TileOrigin
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.ladder import Rung, read_ladder
from rfcore.codec.sender.steering import Steering
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import FieldStore, RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.address import Address
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Hello, RendererContract
from rfcore.wire.tiles import Tile

__all__ = ["Vehicle"]

log = structlog.get_logger()

MAX_JOURNEYS = 3
"""Fields kept ready: the last, the present and the next."""

RETRY_S = 2.0
"""Between questions to a server that does not answer them."""


@dataclass(frozen=True)
class PreparedField:
    """What was made ready for one field before the first frame."""

    field: RadianceField
    pictures: tuple[PosedPicture, ...]
    codec: CodecConfig
    rungs: Rungs
    steering: Steering


class Vehicle:
    """Runs ``config`` from connecting to the end of the drive; ``stop`` ends it early."""

    def __init__(self, config: AgentConfig) -> None:
        self.registry = CollectorRegistry()
        self._servers = tuple(
            _server_end(name, text, config)
            for name, text in (
                ("server", config.server),
                *(("neighbours", text) for text in config.neighbours),
            )
        )
        self._config = config
        self._metrics = AgentMetrics(self.registry)
        self._report: FrameLog | None = None
        self._executor = ThreadPoolExecutor(1, "encoder")
        self._channels: list[grpc.aio.Channel] = []
        self._noticed: list[asyncio.Event] = []
        self._journeys: OrderedDict[str, asyncio.Task[PreparedField]] = OrderedDict()
        self._sessions: deque[AgentSession] = deque(maxlen=4)
        self._stopped = asyncio.Event()

    def stop(self) -> None:
        """Finish the frame in flight, then end."""
        self._stopped.set()

    async def run(self) -> Counter[str]:
        """Drive; return how many pictures ended how. Raises ``RfedgeError``."""
        if self._config.metrics.per_vehicle:
            self._metrics.travelling(self._config.vehicle, self._config.camera)
        self._serve_metrics()
        with structlog.contextvars.bound_contextvars(vehicle=self._config.vehicle):
            return await self._travel()

    async def _travel(self) -> Counter[str]:
        config = self._config
        pictures = await asyncio.to_thread(_read_drive, config, TileOrigin())
        try:
            async with AsyncExitStack() as stack:
                for server in self._servers:
                    self._channels.append(await stack.enter_async_context(server.open()))
                    self._noticed.append(asyncio.Event())
                if config.report is not None:
                    self._report = FrameLog(config.report)
                    stack.callback(self._report.close)
                positions = [
                    picture.camera.world_from_cam.translation_m[:2] for picture in pictures
                ]
                hooks = Hooks(self._make_ready, self._ended, self._moved)
                return await self._drive(HandoverController(config, positions, hooks))
        finally:
            self._executor.shutdown()

    async def _drive(self, trip: HandoverController) -> Counter[str]:
        """Drive while learning what servers publish, until the end or ``stop``."""
        driving = asyncio.create_task(trip.run())
        learning = [asyncio.create_task(self._learn(trip, i)) for i in range(len(self._servers))]
        stopping = asyncio.create_task(self._stopped.wait())
        try:
            waiting: set[asyncio.Task[Any]] = {driving, stopping, *learning}
            while not driving.done():
                done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
                if stopping in done:
                    trip.stop()
            return trip.counts
        finally:
            everything = [driving, stopping, *learning, *self._journeys.values()]
            for task in everything:
                task.cancel()
            await asyncio.gather(*everything, return_exceptions=True)

    def _serve_metrics(self) -> None:
        port = self._config.metrics.port
        if port is not None:
            server, _ = start_http_server(port, self._config.metrics.host, self.registry)
            log.info("metrics", port=server.server_port)

    # --- what servers publish

    async def _learn(self, trip: HandoverController, server: int) -> None:
        """Tell the trip what a server publishes, and again whenever that changes."""
        is_known = False
        while True:
            try:
                tiles = await self._tiles(server)
            except RfedgeError as error:
                if len(self._servers) == 1 and not is_known:
                    raise
                log.warning("tiles not learnt", server=server, problem=str(error))
                await asyncio.sleep(RETRY_S)
                continue
            trip.found(server, [Stop(server, tile) for tile in tiles])
            is_known = True
            await self._noticed[server].wait()
            self._noticed[server].clear()

    async def _tiles(self, server: int) -> tuple[Tile, ...]:
        config, end, channel = self._config, self._servers[server], self._channels[server]
        if config.field is not None:
            return (Tile(WHOLE_STREET, config.field),)
        within_s = config.limits.give_up_s or None
        try:
            await end.reached(channel, within_s)
            async with asyncio.timeout(within_s):
                return await published_tiles(channel)
        except TimeoutError as error:
            raise RfedgeError(f"no server at {end.address} within {within_s:g} s") from error

    # --- legs

    async def _make_ready(self, stop: Stop) -> Ready:
        journey = await self._journey(stop)
        return Ready(journey.pictures, partial(self._agent, stop, journey))

    async def _journey(self, stop: Stop) -> PreparedField:
        """Return what was made ready for the stop's field; tiles of one field share it."""
        journeys, field_id = self._journeys, stop.tile.field_id
        task = journeys.get(field_id)
        if task is None or (task.done() and (task.cancelled() or task.exception())):
            task = journeys[field_id] = asyncio.create_task(self._load(stop))
        journeys.move_to_end(field_id)
        while len(journeys) > MAX_JOURNEYS and next(iter(journeys.values())).done():
            journeys.popitem(last=False)
        return await asyncio.shield(task)

    async def _load(self, stop: Stop) -> PreparedField:
        return await asyncio.to_thread(self._prepare, await self._field(stop))

    async def _field(self, stop: Stop) -> RadianceField:
        """Load the stop's field, fetched from its server if it is not here."""
        config, field_id = self._config, stop.tile.field_id
        fields, render = config.fields.expanduser(), config.render
        store = FieldStore(fields)
        if field_id not in store.ids():
            end, channel = self._servers[stop.server], self._channels[stop.server]
            within_s = config.limits.give_up_s or None
            try:
                await end.reached(channel, within_s)
            except TimeoutError as error:
                raise RfedgeError(f"no server at {end.address} within {within_s:g} s") from error
            await fetch_field(channel, store, field_id, fields)
        return await asyncio.to_thread(store.load, field_id, threads=render.threads, isa=render.isa)

    def _prepare(self, field: RadianceField) -> PreparedField:
        config = self._config
        pictures = _read_drive(config, field.metadata.tile_origin)
        k = pictures[0].camera.intrinsics
        codec = CodecConfig(k.width_px, k.height_px, config.preset, config.crf)
        rungs = self._rungs(field)
        field.prepare()
        self._metrics.field(field.field_id, field.metadata.kind)
        log.info("ready", pictures=len(pictures), field=field.field_id, isa=field.isa)
        steering = config.steering.steering(codec.size_px)
        return PreparedField(field, pictures, codec, rungs, steering)

    def _rungs(self, field: RadianceField) -> Rungs:
        """Return how frames are coded; under a deadline make every renderer it may ask for."""
        config = self._config
        if config.deadline_ms is None:
            return FixedRung(Rung(preset=config.preset))
        ladder = read_ladder(config.ladder, field.metadata.kind, config.crf)
        for measured in ladder:
            field.prepare(measured.rung.quality)
        controller = DeadlineController(ladder, config.deadline_ms)
        log.info(
            "deadline",
            deadline_ms=config.deadline_ms,
            rungs=len(ladder),
            rung=controller.current.rung.name,
        )
        return DeadlineRungs(controller, self._coded)

    def _coded(self, controller: DeadlineController, step: Step | None) -> None:
        self._metrics.coded(controller.position, step, controller.late)
        if step is not None:
            log.info(
                "stepped down" if step.down else "stepped up",
                before=step.before.rung.name,
                rung=step.after.rung.name,
                slowness=round(step.slowness, 2),
            )

    def _agent(self, stop: Stop, journey: PreparedField, pace: CaptureSchedule) -> Agent:
        """Return an agent for a new stream to ``stop``; none of its packets has a number twice."""
        config, channel = self._config, self._channels[stop.server]
        pipeline = Pipeline(
            journey.field,
            journey.codec,
            time.perf_counter_ns,
            rungs=journey.rungs,
            steering=journey.steering,
            threads=config.render.threads,
        )
        intrinsics = journey.pictures[0].camera.intrinsics
        rate_hz = config.rate if config.pace is PaceKind.REALTIME else 0.0
        camera = CameraDescription(config.camera, intrinsics, pipeline.header, rate_hz)
        contract = RendererContract(RENDERER_CONTRACT, exact=True)
        hello = Hello(config.vehicle, (camera,), (journey.field.field_id,), contract)
        first_epoch = max((session.epoch for session in self._sessions), default=-1) + 1
        session = AgentSession(hello, config.limits, _rate_control(config), first_epoch=first_epoch)
        self._sessions.append(session)
        steps = QualitySteps()

        def ended(result: FrameResult) -> None:
            _log_failure(session.session_id, result)
            _log_quality(session.session_id, result, steps)

        equipment = Equipment(
            journey.pictures,
            pace,
            pipeline.encode,
            self._executor,
            partial(self._servers[stop.server].reached, channel),
            ended,
            self._metrics.connected,
            self._noticed[stop.server].set,
        )
        return Agent(channel, session, equipment, config.limits)

    def _ended(self, result: FrameResult) -> None:
        self._metrics.ended(result)
        if self._report is not None:
            self._report.ended(result)

    def _moved(self, stop: Stop, cause: Cause) -> None:
        self._metrics.moved(cause)
        server = str(self._servers[stop.server].address)
        log.info("handed over", server=server, tile=stop.tile.name, cause=str(cause))


def _server_end(name: str, text: str, config: AgentConfig) -> ServerConnection:
    address = Address.parse(name, text)
    tls = config.transport.tls()
    if tls is None:
        address.require_private(name, config.transport.allow_insecure)
    return ServerConnection(address, tls)


def _read_drive(config: AgentConfig, origin: TileOrigin) -> tuple[PosedPicture, ...]:
    """Return the drive's pictures posed relative to ``origin``, all of one camera."""
    pictures = read_dataset(config.drive, tile_origin=origin).pictures
    intrinsics = pictures[0].camera.intrinsics
    for picture in pictures:
        if picture.camera.intrinsics != intrinsics:
            raise InvalidInput(
                "drive",
                f"{picture.name} has other intrinsics than {pictures[0].name}; "
                "one stream is one camera",
            )
    return tuple(map(_posed_for_the_wire, pictures))


def _posed_for_the_wire(picture: PosedPicture) -> PosedPicture:
    """Round the pose before anything is rendered at it: both ends then have the same one."""
    return replace(picture, camera=picture.camera.rounded())


def _log_failure(session_id: str, result: FrameResult) -> None:
    """Say which frame was coded in vain, or worse than asked for to fit the limit; one dropped
    before it was encoded is only counted."""
    if result.packet is None:
        return
    if result.tries > 1 and result.budget is None:
        log.warning(
            "slice above the limit coded again",
            session=session_id,
            seq=result.packet.sequence,
            tries=result.tries,
            payload_bytes=len(result.packet.payload),
        )
    if result.outcome is Outcome.ACKED:
        return
    log.warning(
        f"frame {result.outcome}",
        session=session_id,
        epoch=result.packet.epoch,
        seq=result.packet.sequence,
        reason=result.reason,
    )


def _log_quality(session_id: str, result: FrameResult, steps: QualitySteps) -> None:
    """Say when the link made quality fall, or let it rise, by much."""
    if result.budget is None or result.crf is None:
        return
    step = steps.step(result.crf)
    if step is not None:
        before, after = step
        rate_bps = result.budget.rate_bps
        log.info(
            "quality falls" if after > before else "quality rises",
            session=session_id,
            crf=round(after, 1),
            crf_before=round(before, 1),
            target_bytes=round(result.budget.target_bytes),
            proven_mbps=None if rate_bps is None else round(rate_bps / 1e6, 3),
        )


def _rate_control(config: AgentConfig) -> RateControl | None:
    return None if config.max_delay_ms is None else RateControl(config.max_delay_ms / 1e3)
