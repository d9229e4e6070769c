"""One vehicle put together: servers, fields, streams, metrics, and the drive that uses them.

The path of a frame: ``capture_schedule`` says when a picture is due, ``handover_controller`` which
tile's stream takes it, ``session`` when it is encoded, ``pipeline`` encodes it, ``client`` sends it
and brings the answer back to the session, and the controller hears how it ended.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AsyncExitStack
from functools import partial
from typing import Any

import structlog
from prometheus_client import CollectorRegistry

from cav_agent.client import CameraSource, StreamClient, StreamObserver
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.field_cache import FieldCache, PreparedField, read_drive
from cav_agent.frame_log import DriveObserver, FrameLog
from cav_agent.handover import ServedTile
from cav_agent.handover_controller import HandoverController
from cav_agent.metrics import AgentMetrics
from cav_agent.pipeline import Pipeline, PipelineOptions
from cav_agent.rate_control import RateControl
from cav_agent.server_connection import WHOLE_STREET, ServerConnection, server_connections
from cav_agent.session import AgentSession
from cav_agent.tile_stream import OpenStream
from rfcore.camera import TileOrigin
from rfcore.errors import RfedgeError
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.instruments import MetricsEndpoint
from rfcore.wire.messages import CameraDescription, Hello, RendererContract
from rfcore.wire.settings import MetricsSettings
from rfcore.wire.tiles import Tile

__all__ = ["Vehicle"]

log = structlog.get_logger()

RETRY_S = 2.0
"""Until a server that did not list its tiles is asked again."""


class Vehicle:
    """Runs ``config`` from connecting to the end of the drive; ``stop`` ends it early."""

    def __init__(self, config: AgentConfig) -> None:
        self.registry = CollectorRegistry()
        self._servers = server_connections(config)
        self._config = config
        self._metrics = AgentMetrics(self.registry)
        self._stopped = asyncio.Event()

    def stop(self) -> None:
        """Finish the frame in flight, then end."""
        self._stopped.set()

    async def run(self) -> Counter[str]:
        """Drive; return how many pictures ended how. Raises ``RfedgeError``."""
        config = self._config
        if config.metrics.per_vehicle:
            self._metrics.identify(config.vehicle, config.camera)
        _serve_metrics(config.metrics, self.registry)
        with structlog.contextvars.bound_contextvars(vehicle=config.vehicle):
            pictures = await asyncio.to_thread(read_drive, config, TileOrigin())
            positions = [picture.camera.world_from_cam.translation_m[:2] for picture in pictures]
            async with AsyncExitStack() as stack:
                return await self._drive(await self._controller(stack, positions))

    async def _controller(
        self, stack: AsyncExitStack, positions: Sequence[tuple[float, float]]
    ) -> HandoverController:
        """Open what the drive needs; ``stack`` closes it."""
        config = self._config
        encoder = stack.enter_context(ThreadPoolExecutor(1, "encoder"))
        for server in self._servers:
            await stack.enter_async_context(server)
        frame_log = None
        if config.report is not None:
            frame_log = FrameLog(config.report)
            stack.callback(frame_log.close)
        addresses = [server.address for server in self._servers]
        observer = DriveObserver(self._metrics, addresses, frame_log)
        fields = FieldCache(config, self._servers, observer)
        stack.push_async_callback(fields.close)
        streams = StreamFactory(config, self._servers, fields, encoder)
        return HandoverController(config, positions, streams.prepare, observer)

    async def _drive(self, controller: HandoverController) -> Counter[str]:
        """Drive while learning what servers publish, until the end or ``stop``."""
        driving = asyncio.create_task(controller.run())
        stopping = asyncio.create_task(self._stopped.wait())
        servers = range(len(self._servers))
        learning = [asyncio.create_task(self._follow_tiles(controller, i)) for i in servers]
        tasks: list[asyncio.Task[Any]] = [driving, stopping, *learning]
        try:
            waiting = set(tasks)
            while not driving.done():
                done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
                if stopping in done:
                    controller.stop()
            return controller.counts
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow_tiles(self, controller: HandoverController, number: int) -> None:
        """Tell the controller what a server publishes, and again whenever that changes."""
        server = self._servers[number]
        is_known = False
        while True:
            try:
                tiles = await self._tiles(server)
            except RfedgeError as error:
                if len(self._servers) == 1 and not is_known:
                    raise
                log.warning("tiles not listed", server=str(server.address), problem=str(error))
                await asyncio.sleep(RETRY_S)
                continue
            controller.tiles_published(number, [ServedTile(number, tile) for tile in tiles])
            is_known = True
            await server.fields_changed.wait()
            server.fields_changed.clear()

    async def _tiles(self, server: ServerConnection) -> tuple[Tile, ...]:
        config = self._config
        if config.field is not None:
            return (Tile(WHOLE_STREET, config.field),)
        return await server.published_tiles(config.limits.give_up_s or None)


class StreamFactory:
    """Makes the clients of new streams, whose frames are encoded one at a time on ``encoder``."""

    def __init__(
        self,
        config: AgentConfig,
        servers: Sequence[ServerConnection],
        fields: FieldCache,
        encoder: Executor,
    ) -> None:
        self._config = config
        self._servers = tuple(servers)
        self._fields = fields
        self._encoder = encoder
        self._sessions: deque[AgentSession] = deque(maxlen=4)

    async def prepare(self, served: ServedTile) -> OpenStream:
        """Prepare the tile's field; return how to open a stream with it."""
        prepared = await self._fields.prepared(served)
        return partial(self._client, self._servers[served.server], prepared)

    def _client(
        self, server: ServerConnection, prepared: PreparedField, observer: StreamObserver
    ) -> StreamClient:
        config = self._config
        pipeline = Pipeline(
            prepared.field,
            prepared.codec,
            time.perf_counter_ns,
            PipelineOptions(
                rungs=prepared.rungs,
                steering=prepared.steering,
                threads=config.render.threads,
            ),
        )
        session = self._session(self._hello(prepared, pipeline))
        source = CameraSource(prepared.pictures, pipeline.encode, self._encoder)
        return StreamClient(server, session, source, observer, config.limits)

    def _hello(self, prepared: PreparedField, pipeline: Pipeline) -> Hello:
        config = self._config
        intrinsics = prepared.pictures[0].camera.intrinsics
        rate_hz = config.rate if config.pace is PaceKind.REALTIME else 0.0
        camera = CameraDescription(config.camera, intrinsics, pipeline.header, rate_hz)
        contract = RendererContract(RENDERER_CONTRACT, exact=True)
        return Hello(config.vehicle, (camera,), (prepared.field.field_id,), contract)

    def _session(self, hello: Hello) -> AgentSession:
        """Return a session whose epochs none of the last sessions has used: packets of one camera
        that overlap at a handover have different addresses."""
        first_epoch = max((session.epoch for session in self._sessions), default=-1) + 1
        delay_ms = self._config.max_delay_ms
        rate_control = None if delay_ms is None else RateControl(delay_ms / 1e3)
        session = AgentSession(hello, self._config.limits, rate_control, first_epoch=first_epoch)
        self._sessions.append(session)
        return session


def _serve_metrics(settings: MetricsSettings, registry: CollectorRegistry) -> None:
    """Serve ``registry`` if a port is given; raise ``RfedgeError`` if it cannot be had."""
    if settings.port is None:
        return
    endpoint = MetricsEndpoint(registry, settings.host, settings.port)
    log.info("metrics", port=endpoint.port)
