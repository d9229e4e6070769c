"""One edge server: builds its parts, serves, and drains when told to stop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import grpc
import structlog
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_health.v1.health import aio as health_aio
from prometheus_client import CollectorRegistry

from mec_server.admission import Admission, EntryControl
from mec_server.config import ServerConfig
from mec_server.decoding.decoders import Decoders
from mec_server.edge_service import EdgeService
from mec_server.event_loop import Workers, repeat_forever
from mec_server.fields.published import PublishedFields
from mec_server.fields.service import FieldService
from mec_server.fields.shelf import FieldShelf, field_loader
from mec_server.metrics import BackgroundTask, ServerMetrics
from mec_server.quotas import Quotas
from mec_server.reconstruction import OpenCameras, Tools, open_cameras
from mec_server.recorder import Recorder
from mec_server.server_context import ServerContext
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.service import TwinService
from mec_server.twin.state import Twin
from rfcore.errors import RfedgeError
from rfcore.field import FieldStore
from rfcore.files import write_whole
from rfcore.wire.address import Address
from rfcore.wire.conventions import SERVER_OPTIONS
from rfcore.wire.instruments import MetricsEndpoint

__all__ = ["EdgeServer"]

log = structlog.get_logger()

PUBLICATIONS_EVERY_S = 1.0
"""How often the manifest in the folder of fields is checked for a change: one stat()."""

SERVICES = ("", *(f"rfcore.wire.v1.{name}Service" for name in ("Edge", "Field", "Twin")))


class EdgeServer:
    """Serves the fields of ``config.fields``; ``start``, then ``stop``.

    ``open_decoders`` makes the decoders of a Hello; a load test replaces it.
    """

    def __init__(self, config: ServerConfig, open_decoders: OpenCameras = open_cameras) -> None:
        self.registry = CollectorRegistry()
        self.address = Address.parse("listen", config.listen)
        self._tls = config.transport.tls()
        if self._tls is None:
            self.address.require_private("listen", config.transport.allow_insecure)
        self._config = config
        self._metrics = ServerMetrics(self.registry, per_vehicle=config.metrics.per_vehicle)
        self._metrics.workers.set(config.workers)
        self._metrics_endpoint: MetricsEndpoint | None = None
        outcome_failed = self._failed(BackgroundTask.OUTCOME)
        self._opener = Workers(1, outcome_failed, "opener")
        self._workers = Workers(config.workers, outcome_failed)
        self._decoders = Decoders(
            config.decoder,
            not self.address.is_loopback,
            self._metrics.count_lost_decoder,
            self._failed(BackgroundTask.DECODER_START),
        )
        self._recorder = self._open_recorder(config.save)
        self._health = health_aio.HealthServicer()
        self._store = FieldStore(config.fields)
        load = field_loader(self._store, config.render, opened=self._metrics.field_opened)
        self._shelf = FieldShelf(self._store, load)
        self._published = PublishedFields(config.fields, self._shelf.open)
        self._following: asyncio.Task[None] | None = None
        twin = Twin()
        self._edge = EdgeService(self._context(twin, open_decoders))
        consumer_failed = self._failed(BackgroundTask.CONSUMER)
        self._twin_service = TwinService(
            twin, self._twin_metrics(twin), config.consumers, consumer_failed
        )
        self._server = grpc.aio.server(options=SERVER_OPTIONS)
        self._edge.register(self._server)
        self._twin_service.register(self._server)
        FieldService(self._store, lambda: self._published.tiles).register(self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)

    def _failed(self, task: BackgroundTask) -> Callable[[Exception], None]:
        return partial(self._metrics.task_failed, task)

    def _context(self, twin: Twin, open_decoders: OpenCameras) -> ServerContext:
        config = self._config
        admission = Admission(config.admission, config.workers)
        self._metrics.observe_admission(lambda: admission.promised_share, lambda: admission.reduced)
        return ServerContext(
            fields=self._shelf,
            held_field_ids=self._store.ids,
            workers=self._workers,
            opener=self._opener,
            tools=Tools(time.perf_counter_ns, self._decoders.open),
            metrics=self._metrics,
            limits=config.limits,
            entry=EntryControl(Quotas(config.quota), admission),
            max_streams=config.max_streams,
            twin=twin,
            open_cameras=open_decoders,
            recorder=self._recorder,
        )

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
        await asyncio.to_thread(self._published.start)
        opened = await asyncio.to_thread(self._shelf.warm_up)
        await asyncio.to_thread(self._decoders.start)
        self.address = Address(self.address.host, self._open_port())
        await self._server.start()
        self._following = asyncio.create_task(
            repeat_forever(
                self.take_up_fields,
                PUBLICATIONS_EVERY_S,
                self._failed(BackgroundTask.PUBLICATIONS),
            )
        )
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
        """Take no more frames, finish those taken within ``drain_s``, then close."""
        log.info("draining", within_s=self._config.drain_s)
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._release(self._config.drain_s)
        log.info("stopped")

    async def _release(self, drain_s: float) -> None:
        """Give back everything that ``__init__`` and ``start`` took, as far as they came."""
        if self._following is not None:
            self._following.cancel()
        self._edge.drain()
        self._twin_service.drain()
        await self._server.stop(drain_s)
        await asyncio.to_thread(self._opener.close)
        await asyncio.to_thread(self._workers.close)
        await asyncio.to_thread(self._decoders.close)
        self._twin_service.close()
        if self._recorder is not None:
            await asyncio.to_thread(self._recorder.close)
        if self._metrics_endpoint is not None:
            await asyncio.to_thread(self._metrics_endpoint.close)

    async def take_up_fields(self) -> None:
        """Serve what is published now, and tell the vehicles if it is something else."""
        if await asyncio.to_thread(self._published.refresh):
            self._edge.fields_changed(tuple(tile.field_id for tile in self._published.tiles))

    def _open_port(self) -> int:
        self.address.check_free("--listen")
        try:
            if self._tls is None:
                return self._server.add_insecure_port(str(self.address))
            return self._server.add_secure_port(str(self.address), self._tls.server_credentials())
        except RuntimeError as error:
            raise RfedgeError(f"cannot listen on {self.address}: {error}") from error

    def _open_recorder(self, directory: Path | None) -> Recorder | None:
        if directory is None:
            return None
        self._metrics.recording.set(1)
        return Recorder(directory, self._recording_failed)

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
