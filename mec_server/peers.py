"""Peers of gRPC calls: the identity that a call is charged to, and the status of a refusal.

``ChargeRpcs`` charges every call of the server, whatever its service, for as long as it lasts: also
health checks, calls whose peer does not read its status, those that ``mec_server.guard`` refuses,
and those of unknown methods. An unexpected failure of a call is logged; the peer learns no more
than that it failed.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn, cast

import grpc
import structlog

from mec_server.connections import MOST_HEADER_BYTES, Connections
from mec_server.ledger.budgets import Limit, Resource
from mec_server.ledger.ledger import Hold, Ledger
from mec_server.ledger.peer_log import LogLimiter, PeerLog
from rfcore.errors import (
    AccessDenied,
    BackendUnavailable,
    CodecError,
    InvalidData,
    InvalidInput,
    LimitExceeded,
    PacketRejected,
    ProtocolError,
    RfedgeError,
    UnknownField,
)
from rfcore.wire.conventions import RETRY_AFTER
from rfcore.wire.tls import peer_identity

log = structlog.get_logger()

FAILED = "the server failed in this call, and has logged why"

Context = grpc.aio.ServicerContext[Any, Any]
if TYPE_CHECKING:
    Handler = grpc.RpcMethodHandler[Any, Any]


STATUS_OF: tuple[tuple[type[RfedgeError], grpc.StatusCode], ...] = (
    (InvalidInput, grpc.StatusCode.INVALID_ARGUMENT),
    (UnknownField, grpc.StatusCode.NOT_FOUND),
    (InvalidData, grpc.StatusCode.DATA_LOSS),
    (PacketRejected, grpc.StatusCode.ABORTED),
    (ProtocolError, grpc.StatusCode.FAILED_PRECONDITION),
    (AccessDenied, grpc.StatusCode.PERMISSION_DENIED),
    (LimitExceeded, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (BackendUnavailable, grpc.StatusCode.UNIMPLEMENTED),
    (CodecError, grpc.StatusCode.INTERNAL),
)
"""The gRPC status of each of our errors."""


def status_of(error: RfedgeError) -> grpc.StatusCode:
    """Return the gRPC status for ``error``."""
    for kind, status in STATUS_OF:
        if isinstance(error, kind):
            return status
    return grpc.StatusCode.INTERNAL


CALL_BYTES = 1024
"""Bytes that an admitted call is taken to cost beside a stream's messages: headers and a
request."""


def peer_account(context: Context) -> tuple[str, bool]:
    """Return the identity that a call is charged to, and whether a certificate names it.

    Without a certificate that names an identity, that is the connection.
    """
    identity = peer_identity(context.auth_context())
    if identity is None or not identity.uris:
        return context.peer(), identity is not None
    return identity.uris[0], True


def peer_log(limiter: LogLimiter, context: Context) -> PeerLog:
    """Return a log for lines about the peer of a call, at no more than its identity's rate."""
    identity, _ = peer_account(context)
    return PeerLog(log.bind(peer=context.peer()), limiter, identity, time.monotonic)


async def abort(context: Context, error: RfedgeError) -> NoReturn:
    """End a call with the status of ``error``, and with the time to try again if it has one."""
    await context.abort(status_of(error), str(error), _retry_after(error))
    raise AssertionError("abort raises")


def _retry_after(error: RfedgeError) -> tuple[tuple[str, str], ...]:
    after_s = error.retry_after_s if isinstance(error, LimitExceeded) else None
    return () if after_s is None else ((RETRY_AFTER, str(round(1e3 * after_s))),)


class Slots:
    """Lets each call of one kind hold one of ``resource``.

    ``limited`` counts refusals; ``limiter`` bounds the log lines about peers.
    """

    def __init__(
        self,
        ledger: Ledger,
        resource: Resource,
        limited: Callable[[str], None],
        limiter: LogLimiter,
    ) -> None:
        self._ledger = ledger
        self._resource = resource
        self._limited = limited
        self._limiter = limiter

    def log(self, context: Context) -> PeerLog:
        """Return a log for lines about the peer of a call."""
        return peer_log(self._limiter, context)

    def hold(self, context: Context) -> Hold:
        """Return what the call holds, to be released when it is over; raise ``LimitExceeded``."""
        identity, _ = peer_account(context)
        try:
            return self._ledger.hold(identity, self._resource, time.monotonic())
        except LimitExceeded as error:
            self.count(error)
            raise

    def count(self, error: LimitExceeded) -> None:
        """Count the limit that refused or ended a call."""
        self._limited(error.limit)


Around = Callable[[Context], AbstractAsyncContextManager[Context]]


def handler_within(around: Around, handler: Any) -> Handler:
    """Return ``handler`` with its one behaviour run within ``around`` (see grpc.RpcMethodHandler).

    The behaviour is given the context that ``around`` yields.
    """
    kinds = ("unary_unary", "unary_stream", "stream_unary", "stream_stream")
    (kind,) = (kind for kind in kinds if getattr(handler, kind) is not None)
    behaviour = getattr(handler, kind)

    async def call(request: Any, context: Context) -> Any:
        async with around(context) as seen:
            return await behaviour(request, seen)

    async def generate(request: Any, context: Context) -> AsyncIterator[Any]:
        async with around(context) as seen:
            async for response in behaviour(request, seen):
                yield response

    make = getattr(grpc, f"{kind}_rpc_method_handler")
    wrapped = generate if inspect.isasyncgenfunction(behaviour) else call
    made = make(wrapped, handler.request_deserializer, handler.response_serializer)
    return cast("Handler", made)


async def _unknown_method(requests: AsyncIterator[bytes], context: Context) -> None:  # noqa: ARG001
    await context.abort(grpc.StatusCode.UNIMPLEMENTED, "this server has no such method")


UNKNOWN_METHOD: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(
    _unknown_method
)


class ChargeRpcs(grpc.aio.ServerInterceptor):
    """Charges calls to their identities; ``limited`` counts the limit that refused one.

    ``payer`` returns the context that names the account billed: behind a trusted proxy the
    client's, else the peer's. It belongs before the interceptors that refuse calls, or those cost
    nobody anything.
    """

    def __init__(
        self,
        ledger: Ledger,
        limited: Callable[[str], None],
        limiter: LogLimiter,
        payer: Callable[[Context], Context],
        connections: Connections,
    ) -> None:
        self._ledger = ledger
        self._limited = limited
        self._limiter = limiter
        self._payer = payer
        self._connections = connections

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler | None]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """Return the method's handler, charged for; of an unknown method, or a call of too large
        headers, one that says so."""
        headers = handler_call_details.invocation_metadata
        header_bytes = sum(len(name) + len(value) for name, value in headers)
        if header_bytes > MOST_HEADER_BYTES:
            refusal = partial(self._too_large, header_bytes)
            return handler_within(self._held, grpc.stream_stream_rpc_method_handler(refusal))
        handler = await continuation(handler_call_details)
        return handler_within(self._held, UNKNOWN_METHOD if handler is None else handler)

    async def _too_large(
        self, header_bytes: int, requests: AsyncIterator[bytes], context: Context
    ) -> None:
        """Refuse a call of such headers, and its connection: no client of ours sends them."""
        del requests
        limit = f"{header_bytes} bytes of headers; at most {MOST_HEADER_BYTES} are taken"
        self._connections.offend(context.peer(), Limit.HEADER_BYTES, time.monotonic())
        with suppress(grpc.aio.InternalError):  # of a connection that is gone
            await abort(context, LimitExceeded(Limit.HEADER_BYTES, limit))
        raise asyncio.CancelledError

    @asynccontextmanager
    async def _held(self, context: Context) -> AsyncIterator[Context]:
        """Hold what the call takes while it lasts; an unexpected failure ends it with INTERNAL."""
        with await self._hold(context):
            try:
                yield context
            except grpc.aio.AbortError:
                raise
            except Exception:
                peer_log(self._limiter, self._payer(context)).error("call failed", exc_info=True)
                await context.abort(grpc.StatusCode.INTERNAL, FAILED)

    async def _hold(self, context: Context) -> Hold:
        paying, peer = self._payer(context), context.peer()
        identity, is_named = peer_account(paying)
        if paying is not context:
            self._connections.exempt(peer)
        elif is_named:
            self._connections.claim(peer, identity)
        now = time.monotonic()
        try:
            self._ledger.spend(identity, Resource.CALLS, 1, now)
            hold = self._ledger.hold(identity, Resource.RPCS, now)
        except LimitExceeded as error:
            self._limited(error.limit)
            if error.limit in (Limit.IDENTITY_CALLS, Limit.IDENTITY_RPCS):
                self._connections.refuse(peer, now)
            await abort(context, error)
        self._connections.explain(peer, CALL_BYTES)
        return hold
