"""Calls through a proxy that ends the TLS connection: who the client is.

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

import re
from collections.abc import Iterable, Mapping
from typing import Any, cast
from urllib.parse import unquote

import grpc

from rfcore.errors import AccessDenied
from rfcore.wire.checks import shown
from rfcore.wire.identity import PeerIdentity, Role, identity_uri, peer_identity

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
