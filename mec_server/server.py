"""One edge server: builds its parts, serves, and drains when told to stop."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import grpc
import structlog
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_health.v1.health import aio as health_aio
from prometheus_client import CollectorRegistry, start_http_server

from mec_server.admission import Admission
from mec_server.config import ServerConfig
from mec_server.decoding.decoders import Decoders
from mec_server.edge_service import EdgeService
from mec_server.fields.published import PublishedFields
from mec_server.fields.service import FieldService
from mec_server.fields.shelf import FieldShelf, field_loader
from mec_server.metrics import ServerMetrics
from mec_server.quotas import Quotas
from mec_server.reconstruction import OpenCameras, Tools, open_cameras
from mec_server.recorder import Recorder
from mec_server.server_context import ServerContext
from mec_server.twin.metrics import TwinMetrics
from mec_server.twin.service import TwinService
from mec_server.twin.state import Twin
from mec_server.workers import Workers
from rfcore.errors import RfedgeError
from rfcore.field import FieldStore
from rfcore.files import write_whole
from rfcore.wire.address import Address
from rfcore.wire.conventions import SERVER_OPTIONS

__all__ = ["EdgeServer"]

log = structlog.get_logger()

PUBLICATIONS_EVERY_S = 1.0
"""How often the manifest of the folder of fields is looked at: one stat()."""

SERVICES = ("", *(f"rfcore.wire.v1.{name}Service" for name in ("Edge", "Field", "Twin")))


class EdgeServer:
    """Serves the fields of ``config.fields``; ``start``, then ``stop``.

    ``opened`` makes the decoders of a Hello; a load test has others.
    """

    def __init__(self, config: ServerConfig, opened: OpenCameras = open_cameras) -> None:
        self.registry = CollectorRegistry()
        self.address = Address.parse("listen", config.listen)
        self._tls = config.transport.tls()
        if self._tls is None:
            self.address.require_private("listen", config.transport.allow_insecure)
        self._config = config
        store = FieldStore(config.fields)
        self._metrics = ServerMetrics(self.registry, per_vehicle=config.metrics.per_vehicle)
        self._metrics.workers.set(config.workers)
        load = field_loader(store, config.render, opened=self._metrics.field_opened)
        self._shelf = FieldShelf(store, load)
        admission = Admission(config.admission, config.workers)
        self._metrics.observe_admission(lambda: admission.promised_share, lambda: admission.reduced)
        twin = Twin()  # the metrics outlive the server in their thread, and shall not hold it
        watched = TwinMetrics(
            self._metrics.instruments,
            lambda: twin.ages_s(time.monotonic()),
            lambda: twin.missed,
            per_vehicle=config.metrics.per_vehicle,
        )
        self._twin_service = TwinService(twin, watched, config.consumers)
        self._opener = ThreadPoolExecutor(1, "opener")
        self._workers = Workers(config.workers)
        self._decoders = Decoders(config.decoder, not self.address.is_loopback, self._metrics)
        self._recorder = self._open_recorder(config.save)
        self._health = health_aio.HealthServicer()
        self._edge = EdgeService(
            ServerContext(
                self._shelf,
                store.ids,
                self._workers,
                self._opener,
                Tools(time.perf_counter_ns, self._decoders.open),
                self._metrics,
                config.limits,
                Quotas(config.quota),
                admission,
                config.max_streams,
                twin,
                opened,
                self._recorder,
            )
        )
        self._server = grpc.aio.server(options=SERVER_OPTIONS)
        self._edge.register(self._server)
        self._published = PublishedFields(config.fields, self._shelf.open)
        FieldService(store, lambda: self._published.tiles).register(self._server)
        self._following: asyncio.Task[None] | None = None
        self._twin_service.register(self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)

    async def start(self) -> Address:
        """Open the fields, then the port; return the address, with the port that was taken.

        Raises ``RfedgeError`` for a damaged field or a port that cannot be had.
        """
        await asyncio.to_thread(self._published.start)
        count = await asyncio.to_thread(self._shelf.warm_up)
        await asyncio.to_thread(self._decoders.start)
        try:
            port = self._open_port()
        except RuntimeError as error:
            raise RfedgeError(f"cannot listen on {self.address}: {error}") from error
        self.address = Address(self.address.host, port)
        await self._server.start()
        self._following = asyncio.create_task(self._follow_publications())
        self._serve_metrics()
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)
        if self._config.ready_file is not None:
            write_whole(self._config.ready_file, f"{self.address}\n")
        log.info(
            "serving",
            address=str(self.address),
            fields=count,
            tls=self._tls is not None,
            decoder=str(self._decoders.kind),
        )
        return self.address

    async def stop(self) -> None:
        """Take no more frames, finish those taken within ``drain_s``, then close."""
        log.info("draining", within_s=self._config.drain_s)
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        if self._following is not None:
            self._following.cancel()
        self._edge.drain()
        self._twin_service.drain()
        await self._server.stop(self._config.drain_s)
        await asyncio.to_thread(self._opener.shutdown)
        await asyncio.to_thread(self._workers.close)
        await asyncio.to_thread(self._decoders.close)
        self._twin_service.close()
        if self._recorder is not None:
            await asyncio.to_thread(self._recorder.close)
        log.info("stopped")

    async def take_up_fields(self) -> None:
        """Serve what is published now, and tell the vehicles if it is something else."""
        if await asyncio.to_thread(self._published.refresh):
            self._edge.fields_changed(tuple(tile.field_id for tile in self._published.tiles))

    async def _follow_publications(self) -> None:
        while True:
            await asyncio.sleep(PUBLICATIONS_EVERY_S)
            await self.take_up_fields()

    def _open_port(self) -> int:
        if self._tls is None:
            return self._server.add_insecure_port(str(self.address))
        return self._server.add_secure_port(str(self.address), self._tls.server_credentials())

    def _open_recorder(self, directory: Path | None) -> Recorder | None:
        if directory is None:
            return None
        self._metrics.recording.set(1)
        return Recorder(directory, self._recording_failed)

    def _recording_failed(self, error: OSError) -> None:
        self._metrics.recording.set(0)
        log.error("recording stopped, streaming goes on", problem=str(error))

    def _serve_metrics(self) -> None:
        port = self._config.metrics.port
        if port is not None:
            server, _ = start_http_server(port, self._config.metrics.host, self.registry)
            log.info("metrics", port=server.server_port)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for service in SERVICES:
            await self._health.set(service, status)
