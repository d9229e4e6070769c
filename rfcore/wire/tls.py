"""Mutual TLS: three PEM files per process, checked once, and the gRPC credentials made of them.

Both ends have certificates of the same authority. A server checks its files at every handshake and
uses new ones from then on; open streams are not affected. A client reads its own at the start.
"""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path

import grpc
import structlog

from rfcore.errors import InvalidInput

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
