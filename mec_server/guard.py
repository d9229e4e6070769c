"""Checks every call's certificate: when it is made, and for as long as it is open.

Of a call through a proxy, the client's and the proxy's (``mec_server.proxies``); services see the
client's alone.

An interceptor around all services. A call of a certificate that is revoked, or has expired, is
refused; ``sweep`` ends open ones whose certificate is no longer good, or whose grants changed,
after ``refresh``.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import grpc
import structlog

from mec_server.access import AccessFile, Grant
from mec_server.ledger.peer_log import LogLimiter
from mec_server.peers import handler_within, peer_log
from mec_server.proxies import Proxies
from rfcore.errors import AccessDenied, RfedgeError
from rfcore.wire.identity import PeerIdentity, peer_identity

log = structlog.get_logger()
Context = grpc.aio.ServicerContext[Any, Any]
Handler = Any  # grpc's RpcMethodHandler: of any of four kinds


@dataclass(eq=False)
class OpenCall:
    """An open call, and the reason to end it, if there is one. ``proxy``: the proxy it came
    through."""

    identity: PeerIdentity
    proxy: PeerIdentity | None
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
        proxies: Proxies,
        limiter: LogLimiter,
    ) -> None:
        self._access = access
        self._proxies = proxies
        self._utc_now = utc_now
        self._refused = refused
        self._limiter = limiter
        self._open: set[OpenCall] = set()

    def grant(self, context: Context) -> Grant:
        """Return what the peer of a call may see."""
        return self._access.current.grant(peer_identity(context.auth_context()))

    def may_fetch(self, context: Context, tiles: frozenset[str]) -> bool:
        """Whether the peer of a call may have a field that belongs to ``tiles``."""
        return self._access.current.may_fetch(peer_identity(context.auth_context()), tiles)

    def payer(self, context: Context) -> Context:
        """Return the context that names the account billed: the client behind a trusted proxy, else
        the peer."""
        try:
            return self._client(context)[1]
        except RfedgeError:
            return context

    def _client(self, context: Context) -> tuple[PeerIdentity | None, Context]:
        """Return the proxy of a call, if there is one, and the context that names its client.

        Raises ``AccessDenied`` for a proxy whose certificate is not valid or names nobody.
        """
        proxy = self._proxies.proxy_of(context)
        if proxy is None:
            return None, context
        self._access.current.check(proxy, self._utc_now())
        return proxy, self._proxies.client_context(context)

    def refresh(self) -> None:
        """Read the access file if it changed; not for the event loop."""
        try:
            if self._access.refresh():
                log.info("access list taken up", file=str(self._access.path))
        except RfedgeError as error:
            log.error("access list not taken up, the old one holds", problem=str(error))

    def sweep(self) -> None:
        """End calls that would be refused now."""
        access, now = self._access.current, self._utc_now()
        for call in tuple(self._open):
            try:
                access.check(call.proxy, now)
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
        return None if handler is None else handler_within(self._admitted, handler)

    @asynccontextmanager
    async def _admitted(self, context: Context) -> AsyncIterator[Any]:
        """Hold the call open; yields its context, which names the client behind a proxy."""
        seen, call = await self._admit(context)
        if call is None:
            yield seen
            return
        self._open.add(call)
        try:
            yield seen
        except asyncio.CancelledError:
            if not call.ended:
                raise
            call.task.uncancel()
            self._refused()
            peer_log(self._limiter, seen).warning("call ended", problem=call.ended)
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, call.ended)
        finally:
            self._open.discard(call)

    async def _admit(self, context: Context) -> tuple[Context, OpenCall | None]:
        """Return the context that services are to see, and the call (None in plaintext).

        Aborts the call if its certificate, or its proxy's, is not good.
        """
        try:
            proxy, seen = self._client(context)
            identity = peer_identity(seen.auth_context())
            if identity is None:
                return seen, None
            self._access.current.check(identity, self._utc_now())
            grant = self._access.current.grant(identity)
        except RfedgeError as error:
            self._refused()
            peer_log(self._limiter, self.payer(context)).warning("call refused", problem=str(error))
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, str(error))
            raise AssertionError("abort raises") from error
        task = asyncio.current_task()
        assert task is not None
        return seen, OpenCall(identity, proxy, grant, task)
