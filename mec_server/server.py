"""One edge server: builds its parts, serves, and drains when told to stop."""

from __future__ import annotations

import asyncio
import re
import socket
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
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
from mec_server.config import RecordSettings, ServerConfig
from mec_server.connections import Connections
from mec_server.decoding.decoders import Decoders, DecoderSettings
from mec_server.edge_service import EdgeService
from mec_server.event_loop import (
    BACKGROUND_NICE,
    Workers,
    give_way,
    on_every_thread,
    repeat_forever,
)
from mec_server.fields.index import FieldIndex, PublishedFields, field_loader
from mec_server.fields.service import FieldService
from mec_server.fields.shelf import FieldShelf
from mec_server.guard import Guard
from mec_server.learner import Learner, UnrecordedTrials
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
from mec_server.proxies import Proxies
from mec_server.reconstruction import OpenCameras, Tools, open_cameras
from mec_server.recorder import FieldTiles, KeepLimits, Recorder
from mec_server.stream_decoders import ServerContext
from mec_server.tile_history import TileHistory
from mec_server.tile_learning import LearningJob
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.notices import StreetNotices
from mec_server.twin.rendering import Classify, ViewService
from mec_server.twin.service import ConsumerAccess, TwinService
from mec_server.twin.state import Twin
from rfcore.errors import RfedgeError
from rfcore.field import RadianceField
from rfcore.files import write_whole
from rfcore.wire.address import Address
from rfcore.wire.checks import MAX_FIELDS
from rfcore.wire.conventions import SERVER_OPTIONS
from rfcore.wire.instruments import MetricsEndpoint

if TYPE_CHECKING:
    from mec_server.nats import FieldExchange
    from mec_server.twin.nats import TwinPublisher

__all__ = ["EdgeServer"]

log = structlog.get_logger()

PUBLICATIONS_EVERY_S = 1.0
"""How often the manifest in the folder of fields is checked for a change: one stat()."""

LEARNING_EVERY_S = 1.0
"""How often it is looked whether the learning process runs, and what it has learnt."""

FIELDS_EVERY_S = 1.0
"""How often the folder of fields is listed: one stat() an archive, and its digest if it is new."""

SPARE_RPCS = 64
"""gRPC itself refuses calls beyond the ledger's budget and so many more: those that the ledger is
about to refuse, by name."""
SWEEP_EVERY_S = 1.0
"""How often the access file is checked for a change, and open calls for certificates that are no
longer good."""

NOTICES_EVERY_S = 0.05
"""How soon it is noticed that a vehicle takes notices."""

CONNECTIONS_EVERY_S = 0.05
"""How often connections are counted by address, unless that takes long: they are left alone for
``CONNECTIONS_REST`` times as long as it took."""
CONNECTIONS_REST = 20

NATS_AGAIN_S = 0.1
"""How soon publishing begins, and begins anew after an unexpected exception."""

NATS_FIELDS_S = 20.0
"""How long a server waits at its start for fields that it lacks and NATS may have."""

NATS_END_S = 2.0

DRAWN_S = 20.0
"""Time limit for the start of the threads that decode."""

MOST_OF_A_THREAD = 2
"""Fields that a thread which decodes nothing keeps open: for views, glances and trials."""

CONNECTION_GRACE_MS = 30_000
"""How long streams of a connection that is renewed may go on before they are ended."""

SERVICES = ("", *(f"rfcore.wire.v1.{name}Service" for name in ("Edge", "Field", "Twin")))


class EdgeServer:
    """Serves the fields of ``config.fields``; ``start``, then ``stop``.

    ``open_decoders`` makes the decoders of a Hello; a load test replaces it. ``classify`` names
    what cameras see and the field does not have (``StreetObject.label``): for programs that embed
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
        self._worker_count = config.workers or usable_processors()
        self._metrics.workers.set(self._worker_count)
        self._metrics_endpoint: MetricsEndpoint | None = None
        outcome_failed = self._failed(BackgroundTask.OUTCOME)
        self._log_limiter = LogLimiter()
        self._entry = self._entry_control()
        self._connections = Connections(config.address_connections, config.identity_connections)
        promises = self._entry.promises
        self._opener = Workers(1, outcome_failed, "opener")
        self._background = Workers(
            1, outcome_failed, "background", begin=partial(give_way, BACKGROUND_NICE)
        )
        self._workers = Workers(
            self._worker_count, outcome_failed, crowded=lambda: promises.is_crowded
        )
        self._decoders = Decoders(
            DecoderSettings(config.decoder, self._is_reachable(), config.sandbox_as_root),
            self._metrics.count_lost_decoder,
            self._failed(BackgroundTask.DECODER_START),
            self._log_limiter,
            self._waiting,
        )
        self._health = health_aio.HealthServicer()
        self._lister = ThreadPoolExecutor(1, "lister", give_way, (BACKGROUND_NICE,))
        self._index = FieldIndex(config.fields)
        load = field_loader(self._index, config.render, opened=self._metrics.field_opened)
        self._shelf = FieldShelf(self._index, load)
        self._recorder = self._open_recorder(config.record)
        self._learner = self._open_learner(config)
        self._trials = None if self._learner is None else self._open_trials(self._learner)
        self._published = PublishedFields(config.fields, self._shelf.open)
        self._following: list[asyncio.Task[None]] = []
        self._access = AccessFile(config.access)
        self._access.start()
        self._guard = Guard(
            self._access,
            lambda: datetime.now(UTC),
            self._metrics.refused_certificates.inc,
            Proxies(config.proxy_identity),
            self._log_limiter,
        )
        twin = self._twin = Twin()
        self._edge = EdgeService(self._context(twin, open_decoders))
        consumer_failed = self._failed(BackgroundTask.CONSUMER)
        ledger, limited = self._entry.ledger, self._metrics.count_limited
        self._views = self._twin_views(twin, classify)
        twin_metrics = self._nats_metrics = self._twin_metrics(twin)
        self._notices = StreetNotices(
            twin,
            self._views,
            self._edge.notice_takers,
            lambda: self._published.tiles,
            twin_metrics,
        )
        self._twin_service = TwinService(
            twin,
            twin_metrics,
            Slots(ledger, Resource.WATCHES, limited, self._log_limiter),
            config.limits,
            consumer_failed,
            self._sight,
            self._views,
        )
        self._on_nats: list[asyncio.Task[None]] = []
        self._publisher: TwinPublisher | None = None
        self._exchange: FieldExchange | None = None
        self._server = grpc.aio.server(
            interceptors=(
                ChargeRpcs(
                    ledger, limited, self._log_limiter, self._guard.payer, self._connections
                ),
                self._guard,
            ),
            options=_options(config),
            maximum_concurrent_rpcs=config.server_budget.rpcs + SPARE_RPCS,
        )
        self._edge.register(self._server)
        self._twin_service.register(self._server)
        self._field_service = FieldService(
            self._index,
            lambda: self._published.tiles,
            Slots(ledger, Resource.FETCHES, limited, self._log_limiter),
            config.limits.stalled_s,
            self._guard.may_fetch,
        )
        self._field_service.register(self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)

    def _is_reachable(self) -> bool:
        """Whether packets may come from other machines, by themselves or through a proxy here."""
        return not self.address.is_loopback or bool(self._config.proxy_identity)

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        """Let another thread work while a worker waits for a decoder."""
        with self._workers.waiting(), self._background.waiting():
            yield

    def _failed(self, task: BackgroundTask) -> Callable[[Exception], None]:
        return partial(self._metrics.task_failed, task)

    def _context(self, twin: Twin, open_decoders: OpenCameras) -> ServerContext:
        config = self._config
        return ServerContext(
            fields=self._shelf,
            held_field_ids=self._index.ids,
            workers=self._workers,
            background=self._background,
            opener=self._opener,
            tools=Tools(time.perf_counter_ns, self._decoders.open),
            metrics=self._metrics,
            limits=config.limits,
            entry=self._entry,
            log_limiter=self._log_limiter,
            connections=self._connections,
            twin=twin,
            expect_picture=lambda field_id, camera: self._notices.expect(field_id, camera),
            open_cameras=open_decoders,
            recorder=self._recorder,
            trials=self._trials,
        )

    def _entry_control(self) -> EntryControl:
        config = self._config
        budgets = budgets_of(
            config.identity_budget, config.server_budget, self._worker_count, memory_limit_bytes()
        )
        share = config.identity_budget.share
        now = time.monotonic()
        entry = EntryControl(budgets, config.admission, self._worker_count, share, now)
        self._metrics.observe_ledger(entry, self._log_limiter)
        return entry

    def _twin_views(self, twin: Twin, classify: Classify | None) -> ViewService:
        return ViewService(
            twin,
            self._fields_of_a_thread,
            lambda: self._published.tiles,
            self._entry.ledger,
            self._failed(BackgroundTask.OUTCOME),
            classify,
        )

    def _fields_of_a_thread(self) -> Callable[[str], RadianceField]:
        """Return what opens fields for one thread, with renderers that nobody else uses.

        The numbers of fields that are open for decoding are shared; nothing is read while decoding
        waits for it.
        """
        render = replace(self._config.render, threads=1)
        load_anew = field_loader(self._index, render, opened=lambda _: None)

        def load(field_id: str) -> RadianceField:
            opened = self._shelf.opened(field_id)
            return load_anew(field_id) if opened is None else opened.with_threads(1)

        return FieldShelf(self._index, load, MOST_OF_A_THREAD).open

    def _twin_metrics(self, twin: Twin) -> TwinMetrics:
        return TwinMetrics(
            self._metrics.instruments,
            lambda: twin.ages_s(time.monotonic()),
            lambda: twin.missed,
            per_vehicle=self._config.metrics.per_vehicle,
        )

    async def start(self) -> Address:
        """Open the fields, then the port; return the address, with the port that was taken.

        Raises ``RfedgeError`` for a damaged field or a port that cannot be had, and holds nothing
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
        await self._open_exchange()
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
            self._follow(self._look_at_learning, LEARNING_EVERY_S, BackgroundTask.LEARNING)
        self._follow(self.index_fields, FIELDS_EVERY_S, BackgroundTask.FIELDS)
        if self._config.notices:
            self._follow(self._notices.follow, NOTICES_EVERY_S, BackgroundTask.NOTICES)
        self._follow_connections()
        self._publish_over_nats()
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

    async def stop(self) -> None:
        """Let vehicles move if there is ``drain_hold_s``; then take no more frames,
        finish those taken within ``drain_s``, and close."""
        log.info("draining", hold_s=self._config.drain_hold_s, within_s=self._config.drain_s)
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        if self._config.drain_hold_s:
            await self._send_away()
        await self._release(self._config.drain_s)
        log.info("stopped")

    async def _send_away(self) -> None:
        """Let health checks notice, then let vehicles move while their frames are still taken."""
        await asyncio.sleep(self._config.drain_hold_s)
        left = await self._edge.send_away(self._config.drain_s)
        log.info("vehicles sent away", streams_left=left)

    async def _release(self, drain_s: float) -> None:
        """Give back everything that ``__init__`` and ``start`` took, as far as they came."""
        for task in self._following:
            task.cancel()
        self._edge.drain()
        self._twin_service.drain()
        await self._server.stop(drain_s)
        await self._leave_nats()
        await asyncio.to_thread(self._opener.close)
        await asyncio.to_thread(self._background.close)
        await asyncio.to_thread(self._workers.close)
        await asyncio.to_thread(self._lister.shutdown)
        await asyncio.to_thread(self._decoders.close)
        self._twin_service.close()
        await asyncio.to_thread(self._views.close)
        if self._trials is not None:
            await asyncio.to_thread(self._trials.close)
        if self._learner is not None:
            await asyncio.to_thread(self._learner.close)
        if self._recorder is not None:
            await asyncio.to_thread(self._recorder.close)
        if self._metrics_endpoint is not None:
            await asyncio.to_thread(self._metrics_endpoint.close)

    async def _open_exchange(self) -> None:
        """Fetch the fields that the folder's manifest names and lacks, where other servers put
        theirs."""
        servers = self._config.nats.servers(self._config.transport.allow_insecure)
        if servers is None:
            return
        from mec_server.nats import FieldExchange, NatsLink

        self._exchange = FieldExchange(
            NatsLink(servers, "mec-server fields"),
            self._config.fields,
            self._index,
            lambda: self._published.tiles,
            self._published.look_again,
        )
        await self._exchange.bring_missing(NATS_FIELDS_S)

    def _publish_over_nats(self) -> None:
        servers = self._config.nats.servers(self._config.transport.allow_insecure)
        if servers is None or self._exchange is None:
            return
        from mec_server.nats import NatsLink
        from mec_server.twin.nats import TwinPublisher

        metrics, name = self._nats_metrics, self._config.nats.name or _name_of(self.address)
        link = NatsLink(
            servers,
            f"mec-server {name}",
            lambda connected, _: metrics.nats_connected.set(connected),
        )
        self._publisher = TwinPublisher(
            link,
            name,
            self._twin,
            self._twin_service.pictures,
            lambda: self._published.tiles,
            metrics,
        )
        for work, task in (
            (self._publisher.run, BackgroundTask.NATS_TWIN),
            (self._exchange.run, BackgroundTask.NATS_FIELDS),
        ):
            repeated = repeat_forever(work, NATS_AGAIN_S, self._failed(task))
            self._on_nats.append(asyncio.create_task(repeated))

    async def _leave_nats(self) -> None:
        """Publish the departures of the streams that have just ended, and disconnect."""
        if self._publisher is None:
            return
        await self._publisher.say_farewell()
        for task in self._on_nats:
            task.cancel()
        await asyncio.wait(self._on_nats, timeout=NATS_END_S)

    async def take_up_fields(self) -> None:
        """Serve what is published now, and tell the vehicles if it is something else."""
        before = self._published.tiles
        if await asyncio.to_thread(self._published.refresh):
            tiles = self._published.tiles
            if self._config.notices:
                self._notices.fields_changed(before, tiles)
            self._metrics.show_tiles(tiles)
            every = dict.fromkeys(name for tile in tiles for name in tile.renderable_ids)
            self._edge.fields_changed(tuple(every)[:MAX_FIELDS])

    async def index_fields(self) -> None:
        """Look for archives that were put into the folder, or taken out of it.

        What lies there may take seconds to read: it gives way to frames.
        """
        await asyncio.get_running_loop().run_in_executor(self._lister, self._index.refresh)

    async def _look_at_learning(self) -> None:
        if self._learner is not None:
            await asyncio.to_thread(self._learner.look)

    async def _sweep_calls(self) -> None:
        await asyncio.to_thread(self._guard.refresh)
        self._guard.sweep()
        self._edge.end_stalled(time.monotonic())

    def _follow_connections(self) -> None:
        async def sweep() -> None:
            now = time.monotonic()
            cuts = await asyncio.to_thread(self._connections.sweep, now)
            took_s = time.monotonic() - now
            for cut in cuts:
                limit = cut.limit
                self._metrics.count_limited(limit, cut.count)
                lines = PeerLog(log, self._log_limiter, cut.source, time.monotonic)
                lines.warning(
                    "connections closed",
                    address=cut.source,
                    connections=cut.count,
                    reason=limit,
                    barred=cut.barred,
                )
            await asyncio.sleep(CONNECTIONS_REST * took_s)

        self._follow(sweep, CONNECTIONS_EVERY_S, BackgroundTask.CONNECTIONS)

    def _sight(self, context: grpc.aio.ServicerContext[Any, Any]) -> ConsumerAccess:
        """Return what the peer of a call may see of the twin."""
        grant = self._guard.grant(context)

        def covers(vehicle_id: str, field_id: str) -> bool:
            here = (tile.name for tile in self._published.tiles if field_id in tile.archive_ids)
            return grant.covers(vehicle_id, frozenset(here))

        def may_draw(field_id: str) -> bool:
            here = (tile.name for tile in self._published.tiles if field_id in tile.archive_ids)
            return self._guard.may_fetch(context, frozenset(here))

        return ConsumerAccess(covers, grant.check_vehicles, may_draw)

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

    def _open_recorder(self, settings: RecordSettings) -> Recorder | None:
        if settings.folder is None:
            return None
        self._metrics.recording.set(1)
        limits = KeepLimits(round(settings.max_gb * 1e9), settings.max_age_h * 3600)
        return Recorder(
            settings.folder,
            limits,
            FieldTiles(
                lambda field_id: self._shelf.open(field_id).metadata.tile_origin,
                lambda field_id: self._published.name_of(field_id),
            ),
            lambda: time.time_ns() // 1_000_000,
            self._recording_failed,
        )

    def _open_learner(self, config: ServerConfig) -> Learner | None:
        settings, recordings = config.learn, config.record.folder
        if not settings.on or recordings is None:
            return None
        job = LearningJob(
            config.fields,
            recordings,
            settings.learn_as,
            settings.min_identities,
            cpu_s_per_h=settings.cpu_s_per_h,
            max_bytes=round(settings.max_gb * 1e9),
            max_age_s=settings.max_age_h * 3600,
            quiet_s=settings.quiet_s,
            max_field_bytes=config.render.max_field_bytes,
        )
        return Learner(job, config.log, self._show_learnt)

    def _open_trials(self, learner: Learner) -> UnrecordedTrials:
        failed = self._failed(BackgroundTask.LEARNING)
        return UnrecordedTrials(self._fields_of_a_thread(), failed, learner.report)

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

    def _serve_metrics(self) -> None:
        settings = self._config.metrics
        if settings.port is not None:
            self._metrics_endpoint = MetricsEndpoint(self.registry, settings.host, settings.port)
            log.info("metrics", port=self._metrics_endpoint.port)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for service in SERVICES:
            await self._health.set(service, status)


def _name_of(address: Address) -> str:
    """Return what a server is called that was given no name: its host's name and its port."""
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
