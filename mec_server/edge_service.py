"""EdgeService over grpc.aio: accepts vehicles' streams, and ends each with a gRPC status.

gRPC hands messages over as bytes and ``rfcore.wire.convert`` parses them, so that a message that
cannot be parsed is answered with a Nack like any other, instead of ending the stream.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress

import grpc

from mec_server.ledger.entry import StreamAccount
from mec_server.metrics import BackgroundTask
from mec_server.peers import abort, peer_account
from mec_server.stream import Context, ServerContext, Stream
from rfcore.errors import LimitExceeded
from rfcore.wire.conventions import STREAM_METHOD


class EdgeService:
    """Accepts streams, and ends them when the server drains."""

    def __init__(self, server: ServerContext) -> None:
        self._server = server
        self._streams: set[Stream] = set()
        self._is_leaving = False
        self._stream_closed = asyncio.Event()

    def register(self, server: grpc.aio.Server) -> None:
        """Add the service to a server that has not started."""
        _, service, method = STREAM_METHOD.split("/")
        handler: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(
            self._handle
        )
        server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(service, {method: handler}),)
        )

    async def send_away(self, within_s: float) -> int:
        """Refuse new streams, ask the vehicles of open ones to go elsewhere, and wait until they
        have; return how many are left after ``within_s``."""
        self._is_leaving = True
        for stream in self._streams:
            stream.announce_drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self._streams:
                    self._stream_closed.clear()
                    await self._stream_closed.wait()
        return len(self._streams)

    def drain(self) -> None:
        """Let every stream finish the frames that it has accepted, then end it."""
        for stream in self._streams:
            stream.drain()

    def fields_changed(self, current_field_ids: tuple[str, ...]) -> None:
        """Tell every vehicle which fields are current now."""
        for stream in self._streams:
            stream.fields_changed(current_field_ids)

    def notice_takers(self) -> list[Stream]:
        """Return the streams of vehicles that asked for notices."""
        return [stream for stream in self._streams if stream.takes_notices]

    def end_stalled(self, now: float) -> None:
        """End the streams whose peers take no answers; counted."""
        for stream in tuple(self._streams):
            error = stream.end_if_stalled(now)
            if error is not None:
                self._server.metrics.count_limited(error.limit)

    async def _handle(self, requests: AsyncIterator[bytes], context: Context) -> None:
        """Serve one stream; it is charged for until its status was sent, or its peer is gone."""
        if self._is_leaving:
            await context.abort(grpc.StatusCode.UNAVAILABLE, "this server is shutting down")
        session_id = uuid.uuid4().hex[:12]
        identity, named = peer_account(context)
        entry = self._server.entry
        try:
            account = entry.open(session_id, identity, named, time.monotonic())
        except LimitExceeded as error:
            self._server.metrics.count_limited(error.limit)
            await abort(context, error)
        try:
            await self._serve(requests, context, session_id, account)
        finally:
            account.close()

    async def _serve(
        self,
        requests: AsyncIterator[bytes],
        context: Context,
        session_id: str,
        account: StreamAccount,
    ) -> None:
        stream = Stream(self._server, context, session_id, account, self._regrant)
        self._streams.add(stream)
        self._server.metrics.sessions.inc()
        try:
            end = await stream.run(requests)
        except Exception as error:
            self._server.metrics.task_failed(BackgroundTask.STREAM, error)
            raise
        finally:
            self._streams.discard(stream)
            self._stream_closed.set()
            self._server.metrics.sessions.dec()
            stream.close()
        if end.error is not None:
            if isinstance(end.error, LimitExceeded) and not stream.is_stalled:
                self._server.metrics.count_limited(end.error.limit)
            await abort(context, end.error)

    def _regrant(self, rates_hz: Mapping[str, float]) -> None:
        """Tell the vehicles of these sessions their new rates."""
        for stream in self._streams:
            if stream.session_id in rates_hz:
                stream.grant(rates_hz[stream.session_id])
