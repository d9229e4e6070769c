"""EdgeService over grpc.aio: accepts vehicles' streams, and ends each with a gRPC status.

gRPC hands messages over as bytes and ``rfcore.wire.convert`` parses them, so that a message that
cannot be parsed is answered with a Nack like any other, instead of ending the stream.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator

import grpc
import structlog

from mec_server.metrics import BackgroundTask
from mec_server.quotas import Limit
from mec_server.server_context import ServerContext
from mec_server.stream import Context, Stream
from rfcore.errors import LimitExceeded, RfedgeError
from rfcore.wire.conventions import RETRY_AFTER, STREAM_METHOD
from rfcore.wire.status import status_of

__all__ = ["EdgeService"]

log = structlog.get_logger()


class EdgeService:
    """Accepts streams, and ends them when the server drains."""

    def __init__(self, server: ServerContext) -> None:
        self._server = server
        self._streams: set[Stream] = set()

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        _, service, method = STREAM_METHOD.split("/")
        handler: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(
            self._handle
        )
        server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(service, {method: handler}),)
        )

    def drain(self) -> None:
        """Let every stream finish what it has taken, then end it."""
        for stream in self._streams:
            stream.drain()

    def fields_changed(self, current_field_ids: tuple[str, ...]) -> None:
        """Tell every vehicle which fields are current now."""
        for stream in self._streams:
            stream.fields_changed(current_field_ids)

    async def _handle(self, requests: AsyncIterator[bytes], context: Context) -> None:
        if len(self._streams) >= self._server.max_streams:
            await self._refuse(context)
        stream = Stream(self._server, context, self._reallocate_rates)
        self._streams.add(stream)
        self._server.metrics.sessions.inc()
        try:
            end = await stream.run(requests)
        except Exception as error:
            self._server.metrics.task_failed(BackgroundTask.STREAM, error)
            raise
        finally:
            self._streams.discard(stream)
            self._server.metrics.sessions.dec()
            stream.close()
        if end.error is not None:
            if isinstance(end.error, LimitExceeded):
                self._server.metrics.limited.labels(end.error.limit).inc()
            await context.abort(status_of(end.error), str(end.error), _retry_after(end.error))

    def _reallocate_rates(self) -> None:
        """Tell vehicles whose rate changes."""
        changed = self._server.entry.reallocate_rates(time.monotonic())
        if changed:
            for stream in self._streams:
                stream.regrant(changed)

    async def _refuse(self, context: Context) -> None:
        error = LimitExceeded(
            Limit.SERVER_STREAMS,
            f"{len(self._streams)} streams are open, as many as may be; try again later",
        )
        self._server.metrics.limited.labels(error.limit).inc()
        log.warning("stream refused", peer=context.peer(), problem=str(error))
        await context.abort(status_of(error), str(error))


def _retry_after(error: RfedgeError) -> tuple[tuple[str, str], ...]:
    after_s = error.retry_after_s if isinstance(error, LimitExceeded) else None
    return () if after_s is None else ((RETRY_AFTER, str(round(1e3 * after_s))),)
