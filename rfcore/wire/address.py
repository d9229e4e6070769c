"""Network addresses: whether plaintext is allowed there, and why one cannot be bound or reached.

Plaintext stays on this machine unless it is allowed to leave. gRPC says neither why it cannot bind
a port nor why it cannot connect: it gives no cause, or keeps trying silently. So the standard
library binds the port once beforehand (``Address.check_free``), and makes one handshake with a
server that cannot be reached (``check_handshake``). In TLS 1.3 a server judges a client's
certificate after the client has finished, so what counts in a handshake is the first byte that
comes back (RFC 8446, section 4.4.2.4): HTTP/2's settings, or the end of the connection.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
from contextlib import suppress
from dataclasses import dataclass

from rfcore.errors import AccessDenied, InvalidInput, RfedgeError
from rfcore.wire.tls import TlsFiles
from rfcore.wire.values import shown

ASK_AFTER_S = 1.0
"""Period at which a client without a connection finds out why; gRPC tries again more often."""


@dataclass(frozen=True)
class Address:
    """``host:port``; an IPv6 host stands in brackets in text."""

    host: str
    port: int

    @staticmethod
    def parse(field: str, text: str) -> Address:
        """Return the address in ``text``; raise ``InvalidInput`` naming ``field``."""
        host, colon, port = text.rpartition(":")
        bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
        if not colon or not bare or (":" in bare and bare == host):
            raise InvalidInput(field, f"{shown(text)} must be HOST:PORT, as 127.0.0.1:50051")
        if not (port.isascii() and port.isdigit() and int(port) <= 65535):
            raise InvalidInput(field, f"port {shown(port)} must be a number in 0..65535")
        return Address(bare, int(port))

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the address."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def check_free(self, option: str) -> None:
        """Raise ``RfedgeError`` naming ``option`` if nobody can listen on this address now."""
        if self.port == 0:
            return
        try:
            family = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0][0]
            socket.create_server((self.host, self.port), family=family).close()
        except OSError as error:
            # create_server repeats the address in its message; a failed look-up has no errno of C
            number = error.errno or 0
            problem = os.strerror(number) if number > 0 else error.strerror
            raise RfedgeError(
                f"cannot listen on {self}: {problem}; give another {option}"
            ) from error

    def require_private(self, field: str, allow_insecure: bool) -> None:
        """Raise ``InvalidInput`` for plaintext that would leave the machine without permission."""
        if not (self.is_loopback or allow_insecure):
            raise InvalidInput(
                field,
                f"{self} is not a loopback address and the stream is not encrypted; "
                "give --allow-insecure if the network is trusted",
            )


HANDSHAKE_TIMEOUT_S = 2.0
RENEW = "make new ones (rfedge certs init --replace)"
REMEDIES = {
    9: "set both clocks",  # X509_V_ERR_CERT_NOT_YET_VALID
    10: RENEW,  # X509_V_ERR_CERT_HAS_EXPIRED
    62: "make one for this host (rfedge certs init --replace --hosts)",  # ..._HOSTNAME_MISMATCH
    64: "make one for this host (rfedge certs init --replace --hosts)",  # ..._IP_ADDRESS_MISMATCH
}
OTHER_AUTHORITY = "both ends need certificates and --tls-ca of one authority (rfedge certs add)"
"""Remedy for a certificate that is refused with any other of OpenSSL's codes."""
NOT_TLS = frozenset({"WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG"})
"""OpenSSL's names for an answer that is not a TLS record."""


def check_handshake(address: Address, tls: TlsFiles | None) -> str:
    """Make one connection; return why there is none, or "" where there is one.

    Raises ``AccessDenied`` if the two ends refuse each other: waiting does not help.
    """
    try:
        plain = socket.create_connection((address.host, address.port), HANDSHAKE_TIMEOUT_S)
    except OSError as error:
        return _why_unreachable(address, error)
    try:
        with plain:
            if tls is None:
                _check_plaintext(address, plain)
            else:
                _check_tls(address, plain, tls)
    except TimeoutError:
        return f"{address} takes connections and says nothing: is that a mec-server?"
    except (ssl.SSLEOFError, ConnectionResetError, BrokenPipeError):
        return (
            f"something listens at {address} and closes every connection at once: if that is a "
            "proxy or `rfedge link`, is the server behind it up?"
        )
    except OSError as error:
        return f"{address} breaks the connection off ({error.strerror or error})"
    return ""


def _why_unreachable(address: Address, error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return f"DNS knows no {address.host} ({error.strerror}): check the name"
    if isinstance(error, ConnectionRefusedError):
        return f"refused: nobody listens at {address}; is mec-server running there?"
    if isinstance(error, TimeoutError):
        return (
            f"timeout: {address} does not answer within {HANDSHAKE_TIMEOUT_S:g} s; check address "
            "and firewall"
        )
    return f"{address} cannot be reached: {error.strerror or error}"


def _check_tls(address: Address, plain: socket.socket, tls: TlsFiles) -> None:
    try:
        with tls.client_context().wrap_socket(plain, server_hostname=address.host) as secure:
            welcome = secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        raise AccessDenied(
            f"the certificate of {address} is refused: {_and_remedy(error)} "
            f"(trusted: {tls.authority})"
        ) from error
    except ssl.SSLError as error:
        if error.reason in NOT_TLS:
            raise AccessDenied(
                f"{address} speaks plaintext; start mec-server with --tls-cert, --tls-key and "
                "--tls-ca, or leave them out here"
            ) from error
        if "ALERT" not in (error.reason or ""):
            raise
        welcome = b""
    if not welcome:
        problem = own_problem(tls) or f"it does not know its authority; {OTHER_AUTHORITY}"
        raise AccessDenied(f"{address} refuses {tls.certificate}: {problem}")


def _and_remedy(error: ssl.SSLCertVerificationError) -> str:
    return f"{error.verify_message}; {REMEDIES.get(error.verify_code, OTHER_AUTHORITY)}"


def own_problem(tls: TlsFiles) -> str:
    """Return what is wrong with our own certificate by our own clock and authority, or nothing.

    gRPC's server closes the connection without an alert, so both ends of the handshake are made
    here, in memory, to learn what it would have said.
    """
    judge = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    judge.load_cert_chain(tls.certificate, tls.key)
    judge.load_verify_locations(tls.authority)
    judge.verify_mode = ssl.CERT_REQUIRED
    shown = tls.client_context()
    shown.check_hostname = False
    shown.verify_mode = ssl.CERT_NONE
    to_judge, to_shown = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        shown.wrap_bio(to_shown, to_judge),
        judge.wrap_bio(to_judge, to_shown, server_side=True),
    )
    try:
        for end in ends * 2:  # two flights each way are a whole handshake
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return _and_remedy(error)
    return ""


def _check_plaintext(address: Address, plain: socket.socket) -> None:
    """Raise ``AccessDenied`` for a server that answers a TLS greeting with TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.set_alpn_protocols(["h2"])
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with context.wrap_socket(plain):
            pass
    except ssl.SSLError as error:
        if error.reason in NOT_TLS:
            return
        raise
    raise AccessDenied(f"{address} wants TLS; give --tls-cert, --tls-key and --tls-ca")
