"""Mutual TLS: three PEM files per process, checked once, and the gRPC credentials made of them.

Both ends have certificates of the same authority. A server checks its files at every handshake and
uses new ones from then on; open streams are not affected. A client reads its own at the start.

An identity is one URI as the subject alternative name, in the form of a SPIFFE ID.
``spiffe://rfedge/vehicle/cav-1`` may send frames as ``cav-1`` and as nobody else; every other role
(``server``, ``proxy``, ``consumer``, ``operator``) may send none. What a role may see is for the
server to say (``mec_server.access``). <https://spiffe.io/docs/latest/spiffe-specs/spiffe-id/>

Serial number and end of validity are read from the certificate's DER (RFC 5280, section 4.1): gRPC
has verified its signature, and what is read here is only compared.
"""

from __future__ import annotations

import base64
import ssl
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import grpc
import structlog

from rfcore.errors import AccessDenied, InvalidData, InvalidInput
from rfcore.wire.values import check_name, shown

log = structlog.get_logger()


@dataclass(frozen=True)
class TlsFiles:
    """Own certificate, its private key, and the authority both ends trust; PEM.

    Raises ``InvalidInput`` when one cannot be read or the key is not the certificate's.
    """

    certificate: Path
    key: Path
    authority: Path

    def __post_init__(self) -> None:
        for option, path in self._options():
            try:
                path.read_bytes()
            except OSError as error:
                raise InvalidInput(option, f"{path}: {error.strerror}") from error
        self.client_context()

    @staticmethod
    def of(certificate: Path | None, key: Path | None, authority: Path | None) -> TlsFiles | None:
        """Return the files of ``--tls-cert --tls-key --tls-ca``: all three, or None without any."""
        if certificate is None and key is None and authority is None:
            return None
        if certificate is None or key is None or authority is None:
            raise InvalidInput("tls", "--tls-cert, --tls-key and --tls-ca belong together")
        return TlsFiles(certificate, key, authority)

    def client_context(self) -> ssl.SSLContext:
        """Return a context of the standard library that connects as gRPC does."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.set_alpn_protocols(["h2"])
        try:
            context.load_verify_locations(self.authority)
        except ssl.SSLError as error:
            raise InvalidInput("tls_ca", f"{self.authority} holds no certificate") from error
        try:
            # Without a password an encrypted key would ask for one on the terminal.
            context.load_cert_chain(self.certificate, self.key, password="")
        except ssl.SSLError as error:
            raise InvalidInput(
                "tls_cert",
                f"{self.certificate} and {self.key} are no certificate and its unencrypted key "
                f"({error.reason or error})",
            ) from error
        return context

    def channel_credentials(self) -> grpc.ChannelCredentials:
        """Return a client's credentials for gRPC."""
        return grpc.ssl_channel_credentials(
            root_certificates=self.authority.read_bytes(),
            private_key=self.key.read_bytes(),
            certificate_chain=self.certificate.read_bytes(),
        )

    def server_credentials(self) -> grpc.ServerCredentials:
        """Return a server's credentials for gRPC; a client without a certificate is refused.

        Files that were replaced are used from the next handshake on. As long as they cannot be
        read, or the key does not fit the certificate (only one was replaced yet), the old ones are.
        """
        return grpc.dynamic_ssl_server_credentials(
            self.shown_by_server(),
            Renewal(self).newer,  # type: ignore[arg-type] # stubs leave out None, "no change"
            require_client_authentication=True,
        )

    def changed_ns(self) -> tuple[int, ...]:
        """Return when each file was changed last; raise ``OSError`` if one is not there."""
        return tuple(path.stat().st_mtime_ns for _, path in self._options())

    def shown_by_server(self) -> grpc.ServerCertificateConfiguration:
        """Return what the files hold now, for gRPC."""
        return grpc.ssl_server_certificate_configuration(
            [(self.key.read_bytes(), self.certificate.read_bytes())],
            root_certificates=self.authority.read_bytes(),
        )

    def _options(self) -> tuple[tuple[str, Path], ...]:
        return (
            ("tls_cert", self.certificate),
            ("tls_key", self.key),
            ("tls_ca", self.authority),
        )


class Renewal:
    """Checks whether a server's files were replaced; gRPC asks at every handshake."""

    def __init__(self, files: TlsFiles) -> None:
        self._files = files
        self._taken_ns = files.changed_ns()

    def newer(self) -> grpc.ServerCertificateConfiguration | None:
        """Return what the files hold if they were replaced by good ones, else None."""
        files = self._files
        try:
            changed_ns = files.changed_ns()
            if changed_ns == self._taken_ns:
                return None
            files.client_context()
            shown = files.shown_by_server()
        except (OSError, InvalidInput) as error:
            log.warning("certificate not taken up, the old one is shown", problem=str(error))
            return None
        self._taken_ns = changed_ns
        log.info("certificate taken up", file=str(files.certificate))
        return shown


PREFIX = "spiffe://rfedge/"
CERTIFICATES = 512
"""Certificates that are not read again at each of their calls."""


class Role(StrEnum):
    """Role that a certificate gives its holder."""

    SERVER = "server"
    VEHICLE = "vehicle"
    CONSUMER = "consumer"
    OPERATOR = "operator"
    PROXY = "proxy"


def identity_uri(role: Role, name: str) -> str:
    """Return the URI that stands in the certificate of ``name``."""
    return f"{PREFIX}{role}/{check_name(role, name)}"


def parse_identity(uri: str) -> tuple[Role, str]:
    """Return role and name of an identity; raise ``InvalidInput`` if ``uri`` is none."""
    role, slash, name = uri.removeprefix(PREFIX).partition("/")
    if not uri.startswith(PREFIX) or not slash or role not in set(Role):
        raise InvalidInput("identity", f"{shown(uri)} is no {PREFIX}ROLE/NAME")
    return Role(role), check_name(role, name)


@dataclass(frozen=True)
class PeerIdentity:
    """Contents of a certificate that the authority has signed.

    ``serial`` and ``until`` are None if they could not be read.
    """

    uris: tuple[str, ...]
    serial: int | None = None
    until: datetime | None = None

    def check_vehicle(self, vehicle_id: str) -> None:
        """Raise ``AccessDenied`` unless this is the certificate of ``vehicle_id``."""
        if self.uris != (identity_uri(Role.VEHICLE, vehicle_id),):
            named = ", ".join(shown(uri) for uri in self.uris) or "nobody"
            raise AccessDenied(
                f"vehicle {shown(vehicle_id)} is not whom its certificate names ({named})"
            )

    def role_and_name(self) -> tuple[Role, str]:
        """Return who this is; raise ``AccessDenied`` for a certificate that names not one of us."""
        named = ", ".join(shown(uri) for uri in self.uris) or "nobody"
        if len(self.uris) != 1:
            raise AccessDenied(f"a certificate names one identity, this one {named}")
        try:
            return parse_identity(self.uris[0])
        except InvalidInput as error:
            raise AccessDenied(f"the certificate names {named}, who is unknown here") from error


def peer_identity(auth_context: Mapping[str, Iterable[bytes]]) -> PeerIdentity | None:
    """Return who a gRPC peer is, or None on a connection that is not encrypted."""
    if b"ssl" not in auth_context.get("transport_security_type", ()):
        return None
    uris = auth_context.get("peer_uri", ())
    names = tuple(uri.decode("ascii", "backslashreplace") for uri in uris)
    for pem in auth_context.get("x509_pem_cert", ()):
        return PeerIdentity(names, *_serial_and_end(pem))
    return PeerIdentity(names)


@lru_cache(CERTIFICATES)
def _serial_and_end(pem: bytes) -> tuple[int, datetime]:
    """Return serial number and notAfter of a certificate; raise ``InvalidData``."""
    try:
        text = pem.split(b"-----")[2]
        certificate = _contents(base64.b64decode(text), 0x30)[0]
        rest = _contents(certificate, 0x30)[0]
        if rest[:1] == b"\xa0":  # version, absent in version 1
            rest = _contents(rest, 0xA0)[1]
        serial, rest = _contents(rest, 0x02)
        for _ in ("signature algorithm", "issuer"):
            rest = _contents(rest, 0x30)[1]
        validity = _contents(rest, 0x30)[0]
        not_after = _contents(validity, validity[0])[1]
        end = _contents(not_after, not_after[0])[0].decode("ascii")
        years = end if not_after[0] == 0x18 else ("20" if end[:2] < "50" else "19") + end
        until = datetime.strptime(years, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
        return int.from_bytes(serial, "big", signed=True), until
    except (ValueError, IndexError) as error:
        raise InvalidData("the peer's certificate cannot be read") from error


def _contents(der: bytes, tag: int) -> tuple[bytes, bytes]:
    """Return contents of the first element, which has ``tag``, and what follows it (X.690, 8.1)."""
    if der[0] != tag:
        raise ValueError(f"tag {der[0]:#x} where {tag:#x} is expected")
    start, length = 2, der[1]
    if length & 0x80:
        start += length & 0x7F
        length = int.from_bytes(der[2:start], "big")
    end = start + length
    if end > len(der):
        raise ValueError("the element is cut off")
    return der[start:end], der[end:]
