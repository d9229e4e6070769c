"""Checks every call's certificate: when it is made, and for as long as it is open.

An interceptor around all services. A call of a certificate that is revoked, or has expired, is
refused; ``sweep`` ends open ones whose certificate is no longer good, or whose grants changed.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import grpc
import structlog

from mec_server.access import AccessFile, Grant
from rfcore.errors import AccessDenied, RfedgeError
from rfcore.wire.identity import PeerIdentity, peer_identity

__all__ = ["Guard"]

log = structlog.get_logger()
Handler = Any  # grpc's RpcMethodHandler: of any of four kinds


@dataclass(eq=False)
class OpenCall:
    """A call that is open, and why it is to end."""

    identity: PeerIdentity
    grant: Grant
    task: asyncio.Task[Any]
    ended: str = ""

    def end(self, why: str) -> None:
        """End the call with UNAUTHENTICATED."""
        self.ended = why
        self.task.cancel()


class Guard(grpc.aio.ServerInterceptor):
    """Lets calls in whose certificate ``access`` accepts; ``refused`` is called for each other."""

    def __init__(
        self,
        access: AccessFile,
        utc_now: Callable[[], datetime],
        refused: Callable[[], None],
    ) -> None:
        self._access = access
        self._utc_now = utc_now
        self._refused = refused
        self._open: set[OpenCall] = set()

    def grant(self, context: grpc.aio.ServicerContext[Any, Any]) -> Grant:
        """Return what the peer of a call may see."""
        return self._access.current.grant(peer_identity(context.auth_context()))

    def may_fetch(self, context: grpc.aio.ServicerContext[Any, Any], tiles: frozenset[str]) -> bool:
        """Whether the peer of a call may have a field that belongs to ``tiles``."""
        return self._access.current.may_fetch(peer_identity(context.auth_context()), tiles)

    def sweep(self) -> None:
        """Read the access file if it changed, and end calls that would be refused now."""
        try:
            if self._access.refresh():
                log.info("access list taken up", file=str(self._access.path))
        except RfedgeError as error:
            log.error("access list not taken up, the old one holds", problem=str(error))
        access, now = self._access.current, self._utc_now()
        for call in tuple(self._open):
            try:
                access.check(call.identity, now)
            except AccessDenied as error:
                call.end(str(error))
                continue
            if access.grant(call.identity) != call.grant:
                call.end("what this certificate may see has changed; connect again")

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """Wrap the method's handler."""
        handler = await continuation(handler_call_details)
        if handler is None:
            return None
        for kind in ("unary_unary", "unary_stream", "stream_unary", "stream_stream"):
            behaviour = getattr(handler, kind)
            if behaviour is not None:
                return handler._replace(**{kind: self._guarded(behaviour)})
        return handler

    def _guarded(self, behaviour: Callable[..., Any]) -> Callable[..., Any]:
        if inspect.isasyncgenfunction(behaviour):

            async def generate(request: Any, context: Any) -> AsyncIterator[Any]:
                async with self._admitted(context):
                    async for response in behaviour(request, context):
                        yield response

            return generate

        async def call(request: Any, context: Any) -> Any:
            async with self._admitted(context):
                return await behaviour(request, context)

        return call

    @asynccontextmanager
    async def _admitted(self, context: Any) -> AsyncIterator[None]:
        call = await self._admit(context)
        if call is None:
            yield
            return
        self._open.add(call)
        try:
            yield
        except asyncio.CancelledError:
            if not call.ended:
                raise
            call.task.uncancel()
            self._refused()
            log.warning("call ended", peer=context.peer(), problem=call.ended)
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, call.ended)
        finally:
            self._open.discard(call)

    async def _admit(self, context: Any) -> OpenCall | None:
        """Return the call, or None in plaintext; abort it if its certificate is not good."""
        try:
            identity = peer_identity(context.auth_context())
            if identity is None:
                return None
            self._access.current.check(identity, self._utc_now())
            grant = self._access.current.grant(identity)
        except RfedgeError as error:
            self._refused()
            log.warning("call refused", peer=context.peer(), problem=str(error))
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, str(error))
            raise AssertionError("abort raises") from error
        task = asyncio.current_task()
        assert task is not None
        return OpenCall(identity, grant, task)
