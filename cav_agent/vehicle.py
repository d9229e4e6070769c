"""One vehicle: gets its field, opens its drive, and streams it to the server."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import grpc
import structlog
from prometheus_client import CollectorRegistry, start_http_server

from cav_agent.client import Agent, Equipment
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.deadline import DeadlineController, Step
from cav_agent.field_fetch import choose_field, fetch_field
from cav_agent.frames import FrameResult, Outcome
from cav_agent.metrics import AgentMetrics
from cav_agent.pace import Lockstep, Pace, Realtime
from cav_agent.pipeline import Pipeline
from cav_agent.rate_control import QualitySteps, RateControl
from cav_agent.reach import ServerEnd
from cav_agent.report import Report
from cav_agent.rungs import DeadlineRungs, FixedRung, Rungs
from cav_agent.session import AgentSession
from rfcore.codec import CodecConfig
from rfcore.codec.ladder import Rung, read_ladder
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import FieldStore, RadianceField
from rfcore.views import PosedPicture
from rfcore.wire.address import Address
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.messages import CameraDescription, Hello, RendererContract

__all__ = ["Vehicle"]

log = structlog.get_logger()


@dataclass(frozen=True)
class Journey:
    """What was made ready before the first frame."""

    pictures: tuple[PosedPicture, ...]
    pipeline: Pipeline
    hello: Hello


class Vehicle:
    """Runs ``config`` from connecting to the end of the drive; ``stop`` ends it early."""

    def __init__(self, config: AgentConfig) -> None:
        self.registry = CollectorRegistry()
        address = Address.parse("server", config.server)
        tls = config.transport.tls()
        if tls is None:
            address.require_private("server", config.transport.allow_insecure)
        self._server = ServerEnd(address, tls)
        self._config = config
        self._metrics = AgentMetrics(self.registry)
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
        executor = ThreadPoolExecutor(1, "encoder")
        try:
            async with self._server.open() as channel:
                field = await self._field(channel)
                loop = asyncio.get_running_loop()
                journey = await loop.run_in_executor(executor, self._prepare, field)
                return await self._drive(channel, journey, executor)
        finally:
            executor.shutdown()

    def _serve_metrics(self) -> None:
        port = self._config.metrics.port
        if port is not None:
            server, _ = start_http_server(port, self._config.metrics.host, self.registry)
            log.info("metrics", port=server.server_port)

    async def _field(self, channel: grpc.aio.Channel) -> RadianceField:
        """Load the field, fetched from the server if it is not here."""
        config = self._config
        fields = config.fields.expanduser()
        store = FieldStore(fields)
        within_s = config.limits.give_up_s or None
        try:
            if config.field not in store.ids():
                await self._server.reached(channel, within_s)
            async with asyncio.timeout(within_s):
                field_id = await choose_field(channel, config.field)
        except TimeoutError as error:
            raise RfedgeError(
                f"no server at {self._server.address} within {within_s:g} s"
            ) from error
        if field_id not in store.ids():
            await fetch_field(channel, store, field_id, fields)
        render = config.render
        return await asyncio.to_thread(store.load, field_id, threads=render.threads, isa=render.isa)

    def _prepare(self, field: RadianceField) -> Journey:
        config = self._config
        pictures = read_dataset(config.drive, tile_origin=field.metadata.tile_origin).pictures
        intrinsics = pictures[0].camera.intrinsics
        for picture in pictures:
            if picture.camera.intrinsics != intrinsics:
                raise InvalidInput(
                    "drive",
                    f"{picture.name} has other intrinsics than {pictures[0].name}; "
                    "one stream is one camera",
                )
        pictures = tuple(map(_posed_for_the_wire, pictures))
        codec = CodecConfig(intrinsics.width_px, intrinsics.height_px, config.preset, config.crf)
        rungs = self._rungs(field)
        pipeline = Pipeline(field, codec, time.perf_counter_ns, rungs=rungs)
        rate_hz = config.rate if config.pace is PaceKind.REALTIME else 0.0
        camera = CameraDescription(config.camera, intrinsics, pipeline.header, rate_hz)
        contract = RendererContract(RENDERER_CONTRACT, exact=True)
        hello = Hello(config.vehicle, (camera,), (field.field_id,), contract)
        field.prepare()
        self._metrics.field(field.field_id, field.metadata.kind)
        log.info("ready", pictures=len(pictures), field=field.field_id, isa=field.isa)
        return Journey(pictures, pipeline, hello)

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

    async def _drive(
        self, channel: grpc.aio.Channel, journey: Journey, executor: ThreadPoolExecutor
    ) -> Counter[str]:
        config = self._config
        report = Report(config.report) if config.report is not None else None

        steps = QualitySteps()

        def ended(result: FrameResult) -> None:
            self._metrics.ended(result)
            _log_failure(session.session_id, result)
            _log_quality(session.session_id, result, steps)
            if report is not None:
                report.ended(result)

        pace = _pace(config, len(journey.pictures))
        equipment = Equipment(
            journey.pictures,
            pace,
            journey.pipeline.encode,
            executor,
            partial(self._server.reached, channel),
            ended,
            self._metrics.connected,
        )
        session = AgentSession(journey.hello, config.limits, _rate_control(config))
        agent = Agent(channel, session, equipment, config.limits)
        stopping = asyncio.create_task(self._pass_on_stop(agent))
        try:
            await agent.run()
        finally:
            stopping.cancel()
            if report is not None:
                report.close()
        return agent.counts

    async def _pass_on_stop(self, agent: Agent) -> None:
        await self._stopped.wait()
        agent.stop()


def _posed_for_the_wire(picture: PosedPicture) -> PosedPicture:
    """Round the pose before anything is rendered at it: both ends then have the same one."""
    camera = picture.camera
    rounded = replace(camera, world_from_cam=camera.world_from_cam.rounded())
    return replace(picture, camera=rounded)


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


def _pace(config: AgentConfig, pictures: int) -> Pace:
    if config.pace is PaceKind.LOCKSTEP:
        return Lockstep(pictures, loop=config.loop)
    return Realtime(pictures, config.rate, loop=config.loop)
