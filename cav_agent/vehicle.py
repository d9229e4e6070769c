"""One vehicle put together: servers, fields, streams, metrics, and the drive that uses them.

The path of a frame: ``capture_schedule`` says when a picture is due and ``handover_controller``
which tile's stream takes it from ``cameras``; ``session`` decides when it is encoded, ``pipeline``
encodes it, ``client`` sends it and brings the answer back to the session, and the controller is
told how it ended.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AsyncExitStack
from functools import partial
from typing import Any

import structlog
from prometheus_client import CollectorRegistry

from cav_agent.backoff import Backoff
from cav_agent.camera_poses import (
    CameraPoses,
    DatasetPoses,
    KnownPoses,
    MeasuredRigPoses,
    PoseSource,
    RecordedRigPoses,
    RigCameraPoses,
    RigPoses,
    TrackedRigPoses,
)
from cav_agent.cameras import VehicleCameras, instant_numbers, recorded_cameras
from cav_agent.client import CameraSource, StreamClient, StreamOwner
from cav_agent.config import AgentConfig, PaceKind
from cav_agent.field_cache import FieldCache, PreparedCamera, PreparedField
from cav_agent.frame_log import DriveObserver
from cav_agent.frames import EncodedFrame, EncodeJob, RetryReason
from cav_agent.handover import ServedTile
from cav_agent.handover_controller import HandoverController, OpenStream
from cav_agent.live_cameras import LiveCameras, open_live_cameras
from cav_agent.metrics import AgentMetrics
from cav_agent.notices import NoticeSocket
from cav_agent.pipeline import Pipeline, PipelineOptions
from cav_agent.pose_feed.feed import PoseFeed
from cav_agent.pose_feed.feed_poses import FeedPoses
from cav_agent.pose_feed.fix import FieldPlacement
from cav_agent.pose_feed.sources import FeedKind, FeedTask
from cav_agent.rate_control import BitDivision, RateControl
from cav_agent.server_connection import WHOLE_STREET, ServerConnection, server_connections
from cav_agent.session import AgentSession
from rfcore.camera import TileOrigin
from rfcore.dataset.rig import Rig, read_rig
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField
from rfcore.field.own import OwnField, own_field
from rfcore.named_class import is_named_class
from rfcore.wire.instruments import Family, MetricsEndpoint
from rfcore.wire.messages import CameraDescription, Hello, PoseAhead, RendererContract
from rfcore.wire.notices import StreetNotice
from rfcore.wire.settings import MetricsSettings
from rfcore.wire.tiles import Tile
from rfcore.wire.values import check_name

SEARCH_NICENESS = 5
"""Niceness of the thread that searches poses. Beside it frames take as long as alone: 25 ms on two
cores with other work; beside a thread of their own priority they take 45. At 10 they take no less,
and other work keeps the search from ending."""
_NO_ROUTE = (
    "the street has several tiles, and a live camera without a trajectory does not say which of "
    "them it passes: name the one field with --field, or give [trajectory] in camera.toml"
)

log = structlog.get_logger()

FIRST_RETRY_S, LONGEST_RETRY_S = 0.5, 5.0
"""Pauses before tiles that were not listed are requested again. The list shows that a field was
replaced, so it is requested more often than a refused stream is opened."""


class Vehicle:
    """Runs ``config`` from connecting to the end of the drive; ``stop`` ends it early.

    ``on_notice`` is called, on the event loop, with each notice that a server sends of the street.

    >>> import asyncio, sys
    >>> from pathlib import Path
    >>> from cav_agent.config import AgentConfig, PaceKind
    >>> from cav_agent.vehicle import Vehicle
    >>> from mec_server.config import ServerConfig
    >>> from mec_server.server import EdgeServer
    >>> from rfcore.wire.settings import configure_logs
    >>> fields, drive = Path("samples/fields"), Path("samples/street/transforms_drive_empty.json")
    >>> async def drive_past_a_server():
    ...     server = EdgeServer(ServerConfig(fields, "127.0.0.1:0"))
    ...     await server.start()
    ...     config = AgentConfig(str(server.address), drive, fields, pace=PaceKind.LOCKSTEP)
    ...     counts = await Vehicle(config).run()
    ...     await server.stop()
    ...     return counts
    >>> configure_logs(sys.stderr)
    >>> asyncio.run(drive_past_a_server())
    Counter({'acked': 24})
    """

    def __init__(
        self, config: AgentConfig, on_notice: Callable[[StreetNotice], None] | None = None
    ) -> None:
        self._on_notice = on_notice
        self.registry = CollectorRegistry()
        self._servers = server_connections(config)
        self._config = config
        self._metrics = AgentMetrics(self.registry)
        self._stopped = asyncio.Event()
        self._live: LiveCameras | None = None
        self._own_field: OwnField | None = None
        self._observer: DriveObserver | None = None

    @property
    def explanation(self) -> str:
        """Why no picture was acknowledged, and what to do, after a drive without an Ack."""
        assert self._observer is not None
        return self._observer.explanation()

    @property
    def quality(self) -> dict[str, float]:
        """Luma PSNR of all acknowledged pictures and their latency; empty without one."""
        return {} if self._observer is None else self._observer.quality()

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
            async with AsyncExitStack() as stack:
                return await self._drive(await self._controller(stack))

    async def _controller(self, stack: AsyncExitStack) -> HandoverController:
        """Open what the drive needs; ``stack`` closes it."""
        config, changed = self._config, asyncio.Event()
        rig = None if config.rig is None else _read_rig(config)
        if config.field is not None and is_named_class(config.field):
            self._own_field = await asyncio.to_thread(own_field, config.field)
        recorded = None
        if config.live.source is None and not (rig and rig.is_live):
            recorded = await asyncio.to_thread(
                recorded_cameras, config, TileOrigin(), instant_numbers(config)
            )
        encoder = stack.enter_context(ThreadPoolExecutor(1, "encoder"))
        for server in self._servers:
            await stack.enter_async_context(server)
        frame_log = None
        if config.report is not None:
            frame_log = stack.enter_context(config.report.open("w", buffering=1))
        addresses = [server.address for server in self._servers]
        takers = await self._notice_takers(stack)
        self._observer = observer = DriveObserver(
            self._metrics, addresses, frame_log, takers, config.max_delay_ms
        )
        cameras: VehicleCameras
        if recorded is None:
            cameras = self._live = await self._open_live(stack, rig, observer, changed)
        else:
            cameras = recorded
        fields = FieldCache(config, self._servers, observer, self._live, self._own_field)
        stack.push_async_callback(fields.close)
        feed = await self._open_feed(stack, observer)
        searcher = stack.enter_context(
            ThreadPoolExecutor(1, "localiser", initializer=yield_to_frames)
        )
        streams = StreamFactory(
            config,
            self._servers,
            fields,
            observer,
            encoder,
            searcher,
            feed,
            self._live,
            take_notices=bool(takers),
        )
        positions, schedule = cameras.positions, cameras.schedule
        return HandoverController(config, positions, schedule, streams.prepare, observer, changed)

    async def _notice_takers(self, stack: AsyncExitStack) -> list[Callable[[StreetNotice], None]]:
        """Return what is called with notices; ``stack`` closes the socket, if there is one."""
        takers = [] if self._on_notice is None else [self._on_notice]
        if self._config.notices is not None:
            notices = await stack.enter_async_context(NoticeSocket(self._config.notices))
            takers.append(notices.send)
        return takers

    async def _open_live(
        self,
        stack: AsyncExitStack,
        rig: Rig | None,
        observer: DriveObserver,
        changed: asyncio.Event,
    ) -> LiveCameras:
        """Begin to read the live cameras; ``stack`` ends it."""
        loop = asyncio.get_running_loop()

        def arrived() -> None:
            loop.call_soon_threadsafe(changed.set)

        live = await asyncio.to_thread(open_live_cameras, self._config, rig, observer, arrived)
        stack.push_async_callback(asyncio.to_thread, live.close)
        if self._config.neighbours and not live.knows_route:
            raise RfedgeError(_NO_ROUTE)
        return live

    async def _open_feed(self, stack: AsyncExitStack, observer: DriveObserver) -> PoseFeed | None:
        """Begin to read the vehicle's own poses, if it has any; ``stack`` ends it.

        A file is read before the drive begins.
        """
        settings = self._config.feed
        source = settings.source
        if source is None:
            return None
        recorded = source.kind is FeedKind.FILE
        offset_s = settings.feed_offset_s
        feed = PoseFeed(observer.feed_problem, offset_s=offset_s, recorded=recorded)
        task = FeedTask(source, feed, time.time_ns, observer.feed_fixes)
        if recorded:
            await task.run()
            return feed
        stack.push_async_callback(_cancelled, asyncio.create_task(task.run()))
        return feed

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
        """Pass what a server publishes to the controller, and again whenever that changes."""
        server = self._servers[number]
        is_known = False
        backoff = Backoff(FIRST_RETRY_S, LONGEST_RETRY_S)
        while True:
            server.fields_changed.clear()
            try:
                tiles = await self._tiles(server)
            except RfedgeError as error:
                if len(self._servers) == 1 and not is_known and not _may_pass(error, self._config):
                    raise
                self._metrics.retries.labels(RetryReason.TILES).inc()
                pause_s = backoff.next_s()
                log.warning(
                    "tiles not listed",
                    server=str(server.address),
                    problem=str(error),
                    again_in_s=round(pause_s, 2),
                )
                await asyncio.sleep(pause_s)
                continue
            backoff.reset()
            if self._live is not None and len(tiles) > 1 and not self._live.knows_route:
                raise RfedgeError(_NO_ROUTE)
            controller.tiles_published(number, [ServedTile(number, tile) for tile in tiles])
            is_known = True
            await server.fields_changed.wait()

    async def _tiles(self, server: ServerConnection) -> tuple[Tile, ...]:
        config = self._config
        field_id = config.field if self._own_field is None else self._own_field.field_id
        if field_id is not None:
            return (Tile(WHOLE_STREET, field_id),)
        return await server.published_tiles(config.limits.give_up_s or None)


class StreamFactory:
    """Makes the clients of new streams.

    Frames are encoded one at a time on ``encoder``, poses are searched on ``searcher``.
    """

    def __init__(
        self,
        config: AgentConfig,
        servers: Sequence[ServerConnection],
        fields: FieldCache,
        observer: DriveObserver,
        encoder: Executor,
        searcher: Executor,
        feed: PoseFeed | None = None,
        live: LiveCameras | None = None,
        *,
        take_notices: bool = False,
    ) -> None:
        self._config = config
        self._servers = tuple(servers)
        self._fields = fields
        self._observer = observer
        self._encoder = encoder
        self._searcher = searcher
        self._feed = feed
        self._live = live
        self._take_notices = take_notices
        self._sessions: deque[AgentSession] = deque(maxlen=4)

    async def prepare(self, served: ServedTile) -> OpenStream:
        """Prepare the tile's field; return how to open a stream with it."""
        prepared = await self._fields.prepared(served)
        return partial(self._client, served, prepared)

    def _client(
        self, served: ServedTile, prepared: PreparedField, owner: StreamOwner
    ) -> StreamClient:
        pipelines = {
            camera.camera.camera_id: self._pipeline(prepared, camera, poses)
            for camera, poses in zip(prepared.cameras, self._camera_poses(prepared), strict=True)
        }

        def encode(job: EncodeJob, announce: Callable[[PoseAhead], None]) -> EncodedFrame:
            return pipelines[job.capture.camera_id].encode(job, announce)

        session = self._session(self._hello(prepared, pipelines), prepared)
        source = CameraSource(prepared.pictures.take, encode, self._encoder)
        server, limits = self._servers[served.server], self._config.limits
        return StreamClient(
            server, session, source, owner, self._observer, limits, tile=served.tile.name
        )

    def _pipeline(
        self, prepared: PreparedField, camera: PreparedCamera, poses: CameraPoses
    ) -> Pipeline:
        config = self._config
        options = PipelineOptions(
            check_decode=config.coding.check_decode,
            light=config.coding.light,
            rungs=prepared.rungs,
            qp_map=camera.qp_map,
            threads=config.render.threads,
            lights=prepared.lights,
            poses=poses,
        )
        return Pipeline(prepared.field, camera.codec, time.perf_counter_ns, options)

    def _camera_poses(self, prepared: PreparedField) -> list[CameraPoses]:
        """Return what says where each camera is, the rig's reference camera first."""
        source = self._pose_source(prepared.field)
        tracking = self._tracking(prepared, source) if self._config.localise else None
        extrinsics = [camera.camera.camera_from_rig for camera in prepared.cameras]
        reference = extrinsics[0]
        if reference is None:
            return [tracking or KnownPoses(source)]
        rig: RigPoses = RecordedRigPoses()
        if not isinstance(source, DatasetPoses):
            rig = MeasuredRigPoses(source, reference)
        tracked = None
        if tracking is not None:
            rig = tracked = TrackedRigPoses(tracking, reference, rig)
        return [
            RigCameraPoses(camera_from_rig, rig, None if i else tracked)
            for i, camera_from_rig in enumerate(extrinsics)
            if camera_from_rig is not None
        ]

    def _tracking(self, prepared: PreparedField, source: PoseSource) -> CameraPoses:
        """Return what finds the camera in a field; imports OpenCV, which nothing else here needs.

        Raises ``RfedgeError`` where the extra is not installed.
        """
        from cav_agent.tracking import CameraTracking

        return CameraTracking(
            prepared.lights,
            prepared.cameras[0].camera.intrinsics,
            source,
            self._searcher,
            bounds=prepared.field.bounds,
            patient=self._config.pace is PaceKind.LOCKSTEP,
        )

    def _pose_source(self, field: RadianceField) -> PoseSource:
        """Return what measures the camera's poses, in a field's axes."""
        metadata = field.metadata
        trajectory = None if self._live is None else self._live.poses(metadata.tile_origin)
        if trajectory is not None:
            return trajectory
        if self._feed is None:
            return DatasetPoses()
        mount = self._config.feed.mount
        placement = FieldPlacement(metadata.anchor, metadata.tile_origin, mount)
        return FeedPoses(self._feed, placement, field.bounds, rate_hz=self._config.rate)

    def _hello(self, prepared: PreparedField, pipelines: Mapping[str, Pipeline]) -> Hello:
        config = self._config
        rate_hz = config.rate if config.pace is PaceKind.REALTIME else 0.0
        cameras = tuple(
            CameraDescription(
                camera.camera_id,
                camera.intrinsics,
                pipelines[camera.camera_id].header,
                rate_hz,
                camera.camera_from_rig,
            )
            for camera in prepared.pictures.cameras
        )
        fields = prepared.field_ids
        return Hello(
            config.vehicle,
            cameras,
            fields,
            RendererContract.of(prepared.field),
            config.allow_recording,
            self._take_notices,
        )

    def _session(self, hello: Hello, prepared: PreparedField) -> AgentSession:
        """Return a session whose epochs none of the last sessions has used: packets of one camera
        that overlap at a handover have different addresses."""
        first_epoch = max((session.epoch for session in self._sessions), default=-1) + 1
        delay_ms = self._config.max_delay_ms
        rate_control = None
        if delay_ms is not None:
            rate_control = RateControl(delay_ms / 1e3, self._fields.pace.wait_s)
        cameras = prepared.pictures.cameras
        division = BitDivision({camera.camera_id: camera.priority for camera in cameras})
        session = AgentSession(
            hello,
            self._config.limits,
            rate_control,
            division,
            first_epoch=first_epoch,
            pose_ahead=not self._config.pose_with_frame,
        )
        self._sessions.append(session)
        return session


def _read_rig(config: AgentConfig) -> Rig:
    """Read the rig file, and check what only an agent wants of it."""
    assert config.rig is not None
    rig = read_rig(config.rig)
    for camera in rig.cameras:
        check_name("rig.camera.name", camera.name)
    if rig.is_live and config.pace is not PaceKind.REALTIME:
        raise InvalidInput("pace", f"{config.pace}: a live camera does not wait, use realtime")
    return rig


def metric_families() -> Sequence[Family]:
    """Return the metrics that an agent exports, with everything that an option can add."""
    metrics = AgentMetrics(CollectorRegistry())
    metrics.identify("cav-1", "front")
    return metrics.instruments.families


def yield_to_frames() -> None:
    """Give every other thread priority over the calling one; only Linux has niceness of threads."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        niceness = os.getpriority(os.PRIO_PROCESS, thread) + SEARCH_NICENESS
        os.setpriority(os.PRIO_PROCESS, thread, min(niceness, 19))


def _may_pass(error: RfedgeError, config: AgentConfig) -> bool:
    """Return whether to wait for a server that did not list its tiles at the start.

    A refused certificate, or a choice of field that is missing, is the vehicle's own mistake.
    """
    return type(error) is RfedgeError and not config.limits.give_up_s


async def _cancelled(task: asyncio.Task[None]) -> None:
    """Cancel a task and wait until it has ended."""
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def _serve_metrics(settings: MetricsSettings, registry: CollectorRegistry) -> None:
    """Serve ``registry`` if a port is given; raise ``RfedgeError`` if it cannot be had."""
    if settings.port is None:
        return
    endpoint = MetricsEndpoint(registry, settings.host, settings.port)
    log.info("metrics", port=endpoint.port)
