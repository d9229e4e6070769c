"""Checks every call's certificate: when it is made, and for as long as it is open.

For a call through a proxy it checks the client's certificate and the proxy's; services see the
client's alone.

An interceptor around all services. A call of a certificate that is revoked, or has expired, is
refused; ``sweep`` ends open ones whose certificate is no longer good, or whose grants changed,
after ``refresh``.

A proxy places streams by their metadata, so it must decrypt them. It shows the server a certificate
of its own (``spiffe://rfedge/proxy/NAME``), and names in the header ``x-forwarded-client-cert``
(XFCC) the certificate that the client of each call showed to it. The server believes this header
only from the proxies that it was given (``--proxy-identity NAME``); anybody else may write into it
what they like. A proxy's call without the header, such as a health check, is its own.

The format is Envoy's: ``KEY=VALUE;KEY=VALUE``, values quoted where they must be, a comma between
the certificates of several proxies in a row. One is expected, as ``SANITIZE_SET`` leaves it, with
``URI`` and ``Cert``: the certificate lets the server check the client as if it had connected
itself, for expiry and against the revocation list.
<https://www.envoyproxy.io/docs/envoy/latest/configuration/http/http_conn_man/headers>
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import Any, cast
from urllib.parse import unquote

import grpc
import structlog

from mec_server.access import AccessFile, Grant
from mec_server.ledger.peer_log import LogLimiter
from mec_server.peers import handler_within, peer_log
from rfcore.errors import AccessDenied, RfedgeError
from rfcore.wire.tls import PeerIdentity, Role, identity_uri, peer_identity
from rfcore.wire.values import shown

FORWARDED = "x-forwarded-client-cert"
CLIENTS = frozenset({Role.VEHICLE, Role.CONSUMER, Role.OPERATOR})
PAIR = re.compile(r'([A-Za-z]+)=("(?:[^"\\]|\\.)*"|[^",;]*)')

Context = grpc.aio.ServicerContext[Any, Any]
AuthContext = Mapping[str, Iterable[bytes]]


class Proxies:
    """Trusted proxies, by name; without names none is trusted."""

    def __init__(self, names: Iterable[str]) -> None:
        self._uris = {(identity_uri(Role.PROXY, name),) for name in names}

    def proxy_of(self, context: Context) -> PeerIdentity | None:
        """Return the proxy that a call came through, None if its peer is none of them."""
        identity = peer_identity(context.auth_context()) if self._uris else None
        return identity if identity is not None and identity.uris in self._uris else None

    def client_context(self, context: Context) -> Context:
        """Return the context of a proxy's call with the identity of its client.

        Raises ``AccessDenied`` for a header that does not name one client.
        """
        metadata = context.invocation_metadata() or ()
        headers = [str(value) for key, value in metadata if key == FORWARDED]
        if not headers:
            return context
        if len(headers) != 1:
            raise AccessDenied(f"the proxy sends {len(headers)} headers {FORWARDED}, not one")
        return cast("Context", ForwardedContext(context, forwarded_auth_context(headers[0])))


class ForwardedContext:
    """The context of a call, but for its peer's certificate, which is the proxy's client's."""

    def __init__(self, context: Context, client: AuthContext) -> None:
        self._context = context
        self._client = client

    def auth_context(self) -> AuthContext:
        """Return what gRPC would have said if the client had come by itself."""
        return self._client

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)


def forwarded_auth_context(header: str) -> AuthContext:
    """Return the client that an XFCC header names, in the form of gRPC's ``auth_context``.

    Raises ``AccessDenied`` unless it names one vehicle, consumer or operator, with a certificate.
    """
    pairs = _pairs(header)
    uris = [value for key, value in pairs if key == "uri"]
    certificates = [unquote(value) for key, value in pairs if key == "cert"]
    if len(certificates) != 1:
        raise AccessDenied(f"{FORWARDED} holds {len(certificates)} certificates, not one")
    client: AuthContext = {
        "transport_security_type": (b"ssl",),
        "peer_uri": tuple(uri.encode("ascii", "backslashreplace") for uri in uris),
        "x509_pem_cert": (certificates[0].encode("ascii", "backslashreplace"),),
    }
    identity = peer_identity(client)
    assert identity is not None
    role, name = identity.role_and_name()
    if role not in CLIENTS:
        raise AccessDenied(f"a proxy does not speak for {identity_uri(role, name)}")
    return client


def _pairs(header: str) -> list[tuple[str, str]]:
    """Return keys (lower case) and values of the only element of an XFCC header."""
    pairs, position = [], 0
    while (found := PAIR.match(header, position)) is not None:
        key, value = found.groups()
        pairs.append((key.lower(), _unquoted(value)))
        if found.end() == len(header):
            return pairs
        position = found.end() + 1
        if header[found.end()] == ",":
            raise AccessDenied(f"{FORWARDED} names clients of several proxies; have it set anew")
        if header[found.end()] != ";":
            break
    raise AccessDenied(f"{FORWARDED} cannot be read: {shown(header)}")


def _unquoted(value: str) -> str:
    return re.sub(r"\\(.)", r"\1", value[1:-1]) if value.startswith('"') else value


log = structlog.get_logger()
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
