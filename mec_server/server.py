"""One edge server: builds its parts, serves, and drains when told to stop."""

from __future__ import annotations

import asyncio
import gc
import math
import re
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import grpc
import structlog
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_health.v1.health import aio as health_aio
from prometheus_client import CollectorRegistry

from mec_server.access import AccessFile
from mec_server.config import ServerConfig
from mec_server.connections import Connections
from mec_server.decoding.decoders import Decoders
from mec_server.edge_service import EdgeService
from mec_server.event_loop import (
    BACKGROUND_NICE,
    Workers,
    give_way,
    on_every_thread,
    repeat_forever,
)
from mec_server.fields.index import FieldIndex, PublishedFields, field_loader
from mec_server.fields.service import FieldService, FieldShelf
from mec_server.guard import Guard, Proxies
from mec_server.learner import Learner, UnrecordedTrials, learning_job
from mec_server.ledger.budgets import (
    Resource,
    budgets_of,
    memory_limit_bytes,
    usable_processors,
)
from mec_server.ledger.entry import EntryControl
from mec_server.ledger.peer_log import LogLimiter, PeerLog
from mec_server.metrics import BackgroundTask, ServerMetrics
from mec_server.peers import ChargeRpcs, Slots
from mec_server.reconstruction import DecodingParts, OpenCameras, Tools, open_cameras
from mec_server.recorder import FieldTiles, open_recorder
from mec_server.stream import ServerContext
from mec_server.tile_history import TileHistory
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.notices import StreetNotices
from mec_server.twin.rendering import Classify, ViewService
from mec_server.twin.service import ConsumerAccess, TwinService
from mec_server.twin.state import Twin
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField
from rfcore.field.own import OwnField, own_field
from rfcore.files import write_whole
from rfcore.wire.address import Address
from rfcore.wire.conventions import SERVER_OPTIONS
from rfcore.wire.instruments import Family, MetricsEndpoint
from rfcore.wire.messages import RendererContract
from rfcore.wire.values import MAX_FIELDS
from rfcore.wire.waits import log_wait, waiting

if TYPE_CHECKING:
    from mec_server.twin.nats import NatsServices

log = structlog.get_logger()

PUBLICATIONS_EVERY_S = 1.0
"""Period of checks of the manifest in the folder of fields: one stat() each."""

LEARNING_EVERY_S = 1.0
"""Period of checks of the learning process and its results."""

FIELDS_EVERY_S = 1.0
"""Period of listings of the folder of fields: one stat() an archive, and a digest of new ones."""

SPARE_RPCS = 64
"""Calls beyond the ledger's budget that gRPC still accepts, so that the ledger can refuse them by
name."""
SWEEP_EVERY_S = 1.0
"""Period of checks of the access file, and of open calls for certificates that are no longer
good."""

NOTICES_EVERY_S = 0.05
"""Period of checks whether a vehicle takes notices."""

CONNECTIONS_EVERY_S = 0.05
CONNECTIONS_REST = 20
"""Period of sweeps over all connections, and the least pause after one as a multiple of the time
that it took."""

DROPPED_AGAIN_S = 60.0
"""Shortest time between two log lines about pictures that were not recorded."""

DRAWN_S = 20.0
"""Time limit for the start of the threads that decode."""

MOST_OF_A_THREAD = 2
"""Fields that a thread keeps open which composes views, finds objects or tries learnt fields."""

CONNECTION_GRACE_MS = 30_000
"""Grace period for the streams of a connection that is renewed."""

SERVICES = ("", *(f"rfcore.wire.v1.{name}Service" for name in ("Edge", "Field", "Twin")))


class EdgeServer:
    """Serves the fields of ``config.fields``; ``start``, then ``stop``.

    >>> import asyncio, sys
    >>> from pathlib import Path
    >>> from mec_server.config import ServerConfig
    >>> from mec_server.server import EdgeServer
    >>> from rfcore.wire.settings import configure_logs
    >>> async def serve_for_a_moment() -> str:
    ...     server = EdgeServer(ServerConfig(Path("samples/fields"), listen="127.0.0.1:0"))
    ...     address = await server.start()  # vehicles and consumers may connect now
    ...     await server.stop()
    ...     return address.host
    >>> configure_logs(sys.stderr)
    >>> asyncio.run(serve_for_a_moment())
    '127.0.0.1'

    ``open_decoders`` opens the decoders for a Hello; a load test replaces it. ``classify`` names
    objects that cameras see and the field lacks (``StreetObject.label``), for programs that embed
    the server and have a detector.
    """

    def __init__(
        self,
        config: ServerConfig,
        open_decoders: OpenCameras = open_cameras,
        classify: Classify | None = None,
    ) -> None:
        self.registry = CollectorRegistry()
        self.address = Address.parse("listen", config.listen)
        self._tls = config.transport.tls()
        if self._tls is None:
            self.address.require_private("listen", config.transport.allow_insecure)
        self._config = config
        self._metrics = ServerMetrics(self.registry, per_vehicle=config.metrics.per_vehicle)
        self._metrics_endpoint: MetricsEndpoint | None = None
        self._log_limiter = LogLimiter()
        self._hurried = asyncio.Event()
        self._following: list[asyncio.Task[None]] = []
        self._nats: NatsServices | None = None
        self._make_workers()
        self._make_fields()
        self._access = AccessFile(config.access)
        self._access.start()
        self._guard = Guard(
            self._access,
            lambda: datetime.now(UTC),
            self._metrics.refused_certificates.inc,
            Proxies(config.proxy_identity),
            self._log_limiter,
        )
        self._make_services(open_decoders, classify)

    def _make_workers(self) -> None:
        """Make the threads that decode, the decoders, and what limits their use."""
        config, metrics = self._config, self._metrics
        count = config.workers or usable_processors()
        metrics.workers.set(count)
        budgets = budgets_of(
            config.identity_budget, config.server_budget, count, memory_limit_bytes()
        )
        share, now = config.identity_budget.share, time.monotonic()
        self._entry = EntryControl(budgets, config.admission, count, share, now)
        metrics.observe_ledger(self._entry, self._log_limiter)
        self._connections = Connections(config.address_connections, config.identity_connections)
        failed, promises = self._failed(BackgroundTask.OUTCOME), self._entry.promises
        self._opener = Workers(1, failed, "opener")
        self._background = Workers(1, failed, "background", begin=_give_way)
        self._workers = Workers(count, failed, crowded=lambda: promises.is_crowded)
        self._decoders = Decoders(
            config.decoder,
            reachable=not self.address.is_loopback or bool(config.proxy_identity),
            as_root=config.sandbox_as_root,
            count_loss=metrics.count_lost_decoder,
            start_failed=self._failed(BackgroundTask.DECODER_START),
            limiter=self._log_limiter,
            waiting=self._waiting,
        )

    def _make_fields(self) -> None:
        """Make the index of fields, and what records pictures and learns from them."""
        config = self._config
        self._lister = ThreadPoolExecutor(1, "lister", _give_way)
        made = map(own_field, config.field)
        self._own_fields: Mapping[str, OwnField] = {field.field_id: field for field in made}
        self._index = FieldIndex(config.fields, self._own_fields)
        load = field_loader(self._index, config.render, opened=self._metrics.field_opened)
        self._shelf = FieldShelf(self._index, load)
        self._published = PublishedFields(config.fields, self._shelf.open)
        tiles = FieldTiles(
            lambda field_id: self._shelf.open(field_id).metadata.tile_origin,
            self._published.name_of,
        )
        self._recorder = open_recorder(
            config.record, tiles, self._recording_failed, self._recording_dropped
        )
        self._dropped_told_s = -math.inf
        self._metrics.recording.set(self._recorder is not None)
        self._learner: Learner | None = None
        self._trials: UnrecordedTrials | None = None
        if config.learn.on and config.record.folder is not None:
            job = learning_job(config, config.record.folder)
            self._learner = Learner(job, config.log, self._show_learnt)
            failed = self._failed(BackgroundTask.LEARNING)
            self._trials = UnrecordedTrials(
                self._fields_of_a_thread(), failed, self._learner.report
            )

    def _make_services(self, open_decoders: OpenCameras, classify: Classify | None) -> None:
        """Make the services, and the gRPC server that they belong to."""
        config, ledger, limited = self._config, self._entry.ledger, self._metrics.count_limited
        self._twin = Twin()
        self._edge = EdgeService(self._context(open_decoders))
        self._views = ViewService(
            self._twin,
            self._fields_of_a_thread,
            self._published.current,
            ledger,
            self._failed(BackgroundTask.OUTCOME),
            classify,
        )
        self._twin_metrics = TwinMetrics(
            self._metrics.instruments, self._twin, per_vehicle=config.metrics.per_vehicle
        )
        self._notices = StreetNotices(
            self._twin,
            self._views,
            self._edge.notice_takers,
            self._published.current,
            self._twin_metrics,
        )
        self._twin_service = TwinService(
            self._twin,
            self._twin_metrics,
            Slots(ledger, Resource.WATCHES, limited, self._log_limiter),
            config.limits,
            self._failed(BackgroundTask.CONSUMER),
            self._consumer_access,
            self._views,
        )
        self._field_service = FieldService(
            self._index,
            self._published.current,
            Slots(ledger, Resource.FETCHES, limited, self._log_limiter),
            config.limits.stalled_s,
            self._guard.may_fetch,
        )
        self._health = health_aio.HealthServicer()
        charge = ChargeRpcs(
            ledger, limited, self._log_limiter, self._guard.payer, self._connections
        )
        self._server = grpc.aio.server(
            interceptors=(charge, self._guard),
            options=_options(config),
            maximum_concurrent_rpcs=config.server_budget.rpcs + SPARE_RPCS,
        )
        self._edge.register(self._server)
        self._twin_service.register(self._server)
        self._field_service.register(self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)

    def _context(self, open_decoders: OpenCameras) -> ServerContext:
        decoding = DecodingParts(
            fields=self._shelf,
            workers=self._workers,
            background=self._background,
            opener=self._opener,
            tools=Tools(time.perf_counter_ns, self._decoders.open),
            metrics=self._metrics,
            render_deadline_s=self._config.admission.render_deadline_s,
            open_cameras=open_decoders,
            recorder=self._recorder,
        )
        return ServerContext(
            decoding=decoding,
            held_field_ids=self._index.ids,
            contracts={key: RendererContract.of(own) for key, own in self._own_fields.items()},
            metrics=self._metrics,
            limits=self._config.limits,
            entry=self._entry,
            log_limiter=self._log_limiter,
            connections=self._connections,
            twin=self._twin,
            trials=self._trials,
        )

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        """Let another thread work while a worker waits for a decoder."""
        with self._workers.waiting(), self._background.waiting():
            yield

    def _failed(self, task: BackgroundTask) -> Callable[[Exception], None]:
        return partial(self._metrics.task_failed, task)

    def _fields_of_a_thread(self) -> Callable[[str], RadianceField]:
        """Return a function that opens fields for one thread, with renderers of its own.

        The numbers of fields that are open for decoding are shared; nothing is read while decoding
        waits for it.
        """
        render = replace(self._config.render, threads=1)
        load_anew = field_loader(self._index, render, opened=lambda _: None)

        def load(field_id: str) -> RadianceField:
            opened = self._shelf.opened(field_id)
            return load_anew(field_id) if opened is None else opened.with_threads(1)

        return FieldShelf(self._index, load, MOST_OF_A_THREAD).open

    async def start(self) -> Address:
        """Open the fields, then the port; return the address with the port that was taken.

        Raises ``RfedgeError`` for a damaged field or a port that cannot be had; nothing is held
        after that.
        """
        try:
            return await self._start()
        except BaseException:
            await self._release(drain_s=0.0)
            raise

    async def _start(self) -> Address:
        self._serve_metrics()
        await asyncio.to_thread(self._index.start)
        await self._open_nats()
        await asyncio.to_thread(self._published.start)
        self._metrics.show_tiles(self._published.tiles)
        opened = await asyncio.to_thread(self._shelf.warm_up)
        await on_every_thread((self._workers, self._background), self._shelf.draw_once, DRAWN_S)
        await asyncio.to_thread(self._decoders.start)
        self._metrics.decoder_started(self._decoders.kind)
        self.address = Address(self.address.host, self._open_port())
        await self._server.start()
        self._connections.listen(self.address.port)
        self._follow(self.take_up_fields, PUBLICATIONS_EVERY_S, BackgroundTask.PUBLICATIONS)
        self._follow(self._sweep_calls, SWEEP_EVERY_S, BackgroundTask.ACCESS)
        if self._learner is not None:
            self._learner.start()
            look = partial(asyncio.to_thread, self._learner.look)
            self._follow(look, LEARNING_EVERY_S, BackgroundTask.LEARNING)
        self._follow(self.index_fields, FIELDS_EVERY_S, BackgroundTask.FIELDS)
        if not self._config.no_notices:
            self._follow(self._notices.follow, NOTICES_EVERY_S, BackgroundTask.NOTICES)
        self._follow(self._sweep_connections, CONNECTIONS_EVERY_S, BackgroundTask.CONNECTIONS)
        if self._nats is not None:
            name = self._config.nats.name or _name_of(self.address)
            self._nats.publish(name, self._twin, self._twin_service.pictures, self._twin_metrics)
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)
        if self._config.ready_file is not None:
            write_whole(self._config.ready_file, f"{self.address}\n")
        log.info(
            "serving",
            address=str(self.address),
            fields=opened,
            tls=self._tls is not None,
            decoder=str(self._decoders.kind),
        )
        if not opened:
            log.warning(
                "no fields to serve: every vehicle will be refused",
                folder=str(self._config.fields),
                remedy="put field archives (.rff) into this folder, or give another with --fields; "
                "archives are found without a restart",
            )
        return self.address

    def hurry(self) -> None:
        """End the hold of ``stop`` now."""
        self._hurried.set()

    async def stop(self) -> None:
        """Let vehicles move if ``drain_hold_s`` is set; then finish the frames taken, and close."""
        log.info("draining", hold_s=self._config.drain_hold_s, within_s=self._config.drain_s)
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        if self._config.drain_hold_s:
            with suppress(TimeoutError):  # for health checks to notice
                await asyncio.wait_for(self._hurried.wait(), self._config.drain_hold_s)
            left = await self._edge.send_away(self._config.drain_s)
            log.info("vehicles sent away", streams_left=left)
        await self._release(self._config.drain_s)
        log.info("stopped")

    async def _release(self, drain_s: float) -> None:
        """Release everything that was taken, also by a ``start`` that failed half-way."""
        for task in self._following:
            task.cancel()
        self._edge.drain()
        self._twin_service.drain()
        await self._server.stop(drain_s)
        if self._nats is not None:
            await self._nats.leave()
        for pool in (self._opener, self._background, self._workers):
            await asyncio.to_thread(pool.close)
        await asyncio.to_thread(self._lister.shutdown)
        await asyncio.to_thread(self._decoders.close)
        self._twin_service.close()
        parts = (
            self._views,
            self._trials,
            self._learner,
            self._recorder,
            self._metrics_endpoint,
        )
        for part in parts:
            if part is not None:
                await asyncio.to_thread(part.close)

    async def _open_nats(self) -> None:
        """Fetch the fields that the folder's manifest names and lacks from other servers."""
        servers = self._config.nats.servers(self._config.transport.allow_insecure)
        if servers is None:
            return
        from mec_server.twin.nats import NatsServices

        folder = self._config.fields
        self._nats = NatsServices(
            servers, folder, self._index, self._published, self._metrics.task_failed
        )
        await self._nats.bring_missing()

    async def take_up_fields(self) -> None:
        """Serve the present publication, and announce it to the vehicles if it changed."""
        before = self._published.tiles
        if await asyncio.to_thread(self._published.refresh):
            tiles = self._published.tiles
            if not self._config.no_notices:
                self._notices.fields_changed(before, tiles)
            self._metrics.show_tiles(tiles)
            every = dict.fromkeys(name for tile in tiles for name in tile.renderable_ids)
            self._edge.fields_changed(tuple(every)[:MAX_FIELDS])

    async def index_fields(self) -> None:
        """Look for archives that were put into the folder, or taken out of it.

        What lies there may take seconds to read: it gives way to frames.
        """
        await asyncio.get_running_loop().run_in_executor(self._lister, self._index.refresh)

    async def _sweep_calls(self) -> None:
        await asyncio.to_thread(self._guard.refresh)
        self._guard.sweep()
        self._edge.end_stalled(time.monotonic())

    async def _sweep_connections(self) -> None:
        """Close connections that cost too much, then leave them alone for a while."""
        now = time.monotonic()
        closed = await asyncio.to_thread(self._connections.sweep, now)
        took_s = time.monotonic() - now
        for each in closed:
            limit = each.limit
            self._metrics.count_limited(limit, each.count)
            lines = PeerLog(log, self._log_limiter, each.source, time.monotonic)
            lines.warning(
                "connections closed",
                address=each.source,
                connections=each.count,
                reason=limit,
                barred=each.barred,
            )
        await asyncio.sleep(CONNECTIONS_REST * took_s)

    def _consumer_access(self, context: grpc.aio.ServicerContext[Any, Any]) -> ConsumerAccess:
        """Return what the peer of a call may see of the twin."""
        grant = self._guard.grant(context)

        def covers(vehicle_id: str, field_id: str) -> bool:
            return grant.covers(vehicle_id, self._published.names_of(field_id))

        def may_draw(field_id: str) -> bool:
            return self._guard.may_fetch(context, self._published.names_of(field_id))

        published = frozenset(tile.name for tile in self._published.tiles)
        may_see = grant.described(published)
        return ConsumerAccess(covers, grant.check_vehicles, may_draw, may_see)

    def _follow(
        self, work: Callable[[], Awaitable[object]], every_s: float, task: BackgroundTask
    ) -> None:
        self._following.append(
            asyncio.create_task(repeat_forever(work, every_s, self._failed(task)))
        )

    def _open_port(self) -> int:
        self.address.check_free("--listen")
        try:
            if self._tls is None:
                return self._server.add_insecure_port(str(self.address))
            return self._server.add_secure_port(str(self.address), self._tls.server_credentials())
        except RuntimeError as error:
            raise RfedgeError(f"cannot listen on {self.address}: {error}") from error

    def _show_learnt(self, histories: Mapping[str, TileHistory]) -> None:
        self._metrics.show_learnt(histories)
        if self._trials is not None:
            self._trials.watch(histories)
        self._field_service.show_learnt(
            one for name, history in histories.items() for one in history.newest(name)
        )

    def _recording_failed(self, error: Exception) -> None:
        self._metrics.recording.set(0)
        if not isinstance(error, OSError):
            self._metrics.task_failed(BackgroundTask.RECORDING, error)
        log.error("recording stopped, streaming goes on", problem=str(error))

    def _recording_dropped(self) -> None:
        """Runs on the threads that decode."""
        self._metrics.recording_dropped.inc()
        now = time.monotonic()
        if now - self._dropped_told_s >= DROPPED_AGAIN_S:
            self._dropped_told_s = now
            log.warning("the disk is too slow, pictures are not recorded")

    def _serve_metrics(self) -> None:
        settings = self._config.metrics
        if settings.port is not None:
            self._metrics_endpoint = MetricsEndpoint(self.registry, settings.host, settings.port)
            log.info("metrics", port=self._metrics_endpoint.port)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for service in SERVICES:
            await self._health.set(service, status)


async def serve(config: ServerConfig, opened: OpenCameras = open_cameras) -> None:
    """Serve until SIGTERM or SIGINT, then drain; a second signal ends the hold."""
    server = EdgeServer(config, opened)
    stopped = asyncio.Event()

    def stop() -> None:
        if stopped.is_set():
            server.hurry()
        stopped.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop)
    with waiting(f"fields of {config.fields} to be opened", log_wait):
        await server.start()
    gc.collect()
    gc.freeze()  # a search of all objects for cycles stops every thread for 50 ms
    await stopped.wait()
    gc.unfreeze()  # so that objects of the native library are collected at the end
    await server.stop()


def metric_families() -> Sequence[Family]:
    """Return the metrics that a server exports, with everything that an option can add."""
    metrics = ServerMetrics(CollectorRegistry(), per_vehicle=True)
    TwinMetrics(metrics.instruments, Twin(), per_vehicle=True)
    return metrics.instruments.families


def _give_way() -> None:
    give_way(BACKGROUND_NICE)


def _name_of(address: Address) -> str:
    """Return the name of a server that was given none: its host's name and its port."""
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname()).strip(".-")[:50]
    return f"{host or 'server'}-{address.port}"


def _options(config: ServerConfig) -> tuple[tuple[str, int], ...]:
    if not config.max_connection_age_s:
        return SERVER_OPTIONS
    return (
        *SERVER_OPTIONS,
        ("grpc.max_connection_age_ms", round(1e3 * config.max_connection_age_s)),
        ("grpc.max_connection_age_grace_ms", CONNECTION_GRACE_MS),
    )
