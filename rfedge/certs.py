"""A certificate authority for one deployment: X.509 version 3 (RFC 5280), ECDSA on P-256.

Each certificate names one identity (``rfcore.wire.tls``), a server's also its hosts. The
authority's own certificate may sign certificates only, and no certificate that it signed may sign.

``write_certificates`` writes a folder of certificates and keys as a whole or not at all, with keys
readable by their owner only; ``read_certificates`` reads them back for display.
"""

from __future__ import annotations

import ipaddress
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from rfcore.errors import InvalidData, InvalidInput
from rfcore.extras import needs
from rfcore.files import whole_folder, write_whole
from rfcore.wire.tls import Role, identity_uri
from rfcore.wire.values import shown

with needs("ops"):
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

MAX_DAYS = 3650
BACKDATED = timedelta(hours=1)
"""New certificates are valid from a little earlier, for clients whose clocks are slow."""


@dataclass(frozen=True)
class Members:
    """The names that get certificates; ``hosts`` are names or addresses of the server."""

    vehicles: tuple[str, ...]
    consumers: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ("localhost", "127.0.0.1", "::1")
    operators: tuple[str, ...] = ()
    proxies: tuple[str, ...] = ()

    @property
    def clients(self) -> tuple[tuple[Role, tuple[str, ...]], ...]:
        """The names of all clients, by role."""
        return (
            (Role.VEHICLE, self.vehicles),
            (Role.CONSUMER, self.consumers),
            (Role.OPERATOR, self.operators),
            (Role.PROXY, self.proxies),
        )

    def __post_init__(self) -> None:
        for role, names in self.clients:
            for name in names:
                identity_uri(role, name)
            if len(set(names)) != len(names):
                group = "proxies" if role is Role.PROXY else f"{role}s"
                raise InvalidInput(group, f"{', '.join(names)}: a name is there twice")
        if not self.hosts:
            raise InvalidInput("hosts", "a server without a name cannot be reached")
        for host in self.hosts:
            _host_name(host)


@dataclass(frozen=True)
class Issued:
    """One certificate as PEM, the name of its file, and the identity in it."""

    name: str
    identity: str
    certificate: bytes
    key: bytes


@dataclass(frozen=True)
class _Authority:
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    now: datetime
    days: int


def certify(members: Members, now: datetime, days: int) -> tuple[Issued, ...]:
    """Make an authority and sign a certificate for every member, valid ``days`` from ``now``."""
    _check_days(days)
    authority = _authority(now, days)
    server = [x509.UniformResourceIdentifier(identity_uri(Role.SERVER, "edge"))]
    issued = [
        _issued("ca", "the authority", authority.certificate, authority.key),
        _signed(authority, "server", [*server, *(_host_name(host) for host in members.hosts)]),
    ]
    return (*issued, *_clients(authority, members))


def _clients(authority: _Authority, members: Members) -> Iterator[Issued]:
    for role, names in members.clients:
        for name in names:
            uri = x509.UniformResourceIdentifier(identity_uri(role, name))
            yield _signed(authority, f"{role}-{name}", [uri])


def add_certificates(
    folder: Path, members: Members, now: datetime, days: int
) -> tuple[Issued, ...]:
    """Sign certificates for further clients with the authority in ``folder``, and write them there.

    Existing certificates stay as they are. Raises ``InvalidInput`` for a name that has a
    certificate already, or a folder without the authority's key; ``InvalidData`` for a key that is
    not the authority's.
    """
    _check_days(days)
    issued = tuple(_clients(_read_authority(folder, now, days), members))
    if not issued:
        raise InvalidInput("certs", "name at least one vehicle, consumer, operator or proxy to add")
    there = [one.name for one in issued if (folder / f"{one.name}.pem").exists()]
    if there:
        raise InvalidInput("certs", f"{folder} has a certificate of {', '.join(there)} already")
    for one in issued:
        _write_key(folder / f"{one.name}.key", one.key)
        write_whole(folder / f"{one.name}.pem", one.certificate.decode("ascii"))
    return issued


def _read_authority(folder: Path, now: datetime, days: int) -> _Authority:
    try:
        pem, secret = ((folder / name).read_bytes() for name in ("ca.pem", "ca.key"))
    except OSError as error:
        raise InvalidInput("certs", f"{folder} does not hold ca.pem and ca.key") from error
    try:
        certificate = x509.load_pem_x509_certificate(pem)
        key = serialization.load_pem_private_key(secret, None)
    except (TypeError, ValueError) as error:
        raise InvalidData(f"{folder} holds no authority: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or (
        key.public_key() != certificate.public_key()
    ):
        raise InvalidData(f"{folder / 'ca.key'} is not the key of ca.pem")
    if now + timedelta(days=days) > certificate.not_valid_after_utc:
        raise InvalidInput(
            "days", f"{days} is beyond the authority's end, {certificate.not_valid_after_utc:%F}"
        )
    return _Authority(certificate, key, now, days)


def _check_days(days: int) -> None:
    if not 1 <= days <= MAX_DAYS:
        raise InvalidInput("days", f"{days} is outside 1..{MAX_DAYS}")


def _authority(now: datetime, days: int) -> _Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject("rfedge authority")
    signs = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        _builder(subject, key, now, days)
        .issuer_name(subject)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(signs, critical=True)
        .sign(key, hashes.SHA256())
    )
    return _Authority(certificate, key, now, days)


def _signed(authority: _Authority, name: str, names: list[x509.GeneralName]) -> Issued:
    key = ec.generate_private_key(ec.SECP256R1())
    usage = ExtendedKeyUsageOID.SERVER_AUTH if name == "server" else ExtendedKeyUsageOID.CLIENT_AUTH
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    certificate = (
        _builder(_subject(name[:64]), key, authority.now, authority.days)
        .issuer_name(authority.certificate.subject)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(issuer, critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    return _issued(name, str(names[0].value), certificate, key)


def _builder(
    subject: x509.Name, key: ec.EllipticCurvePrivateKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    """Return a builder with the fields that all certificates have in common."""
    own = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(own, critical=False)
    )


def _issued(
    name: str, identity: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> Issued:
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return Issued(name, identity, certificate.public_bytes(pem), secret)


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _host_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not host.isascii() or not host.replace("-", "").replace(".", "").isalnum():
        raise InvalidInput("hosts", f"{shown(host)} is neither a host name nor an address")
    return x509.DNSName(host)


def write_certificates(folder: Path, issued: Sequence[Issued], *, replace: bool = False) -> None:
    """Write ``NAME.pem`` and ``NAME.key`` (mode 0600) of each certificate into a new folder.

    With ``replace``, a folder that holds nothing but certificates is replaced at the end. Raises
    ``InvalidInput`` if the folder exists and may not be replaced, and ``OSError``.
    """
    if not replace and folder.exists():
        raise InvalidInput("out", f"{folder} exists; --replace makes all its certificates anew")
    if replace and folder.exists():
        _check_replaceable(folder)
    new, old = (folder.with_name(f"{folder.name}.{age}") for age in ("new", "old"))
    with whole_folder(new) as partial:
        partial.chmod(0o700)
        for one in issued:
            (partial / f"{one.name}.pem").write_bytes(one.certificate)
            _write_key(partial / f"{one.name}.key", one.key)
        partial.chmod(0o755)  # services of other users read ca.pem; keys have their own mode
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _check_replaceable(folder: Path) -> None:
    if folder.is_symlink() or not (folder / "ca.pem").is_file():
        raise InvalidInput("out", f"{folder} is no folder that `rfedge certs init` made")
    strangers = sorted(p.name for p in folder.iterdir() if p.suffix not in (".pem", ".key"))
    if strangers:
        raise InvalidInput("out", f"{folder} also holds {', '.join(strangers)}; move it away")


def _write_key(path: Path, key: bytes) -> None:
    """Write a file that only its owner can read, from the moment it exists."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:  # noqa: PTH123 (a descriptor, not a path)
        file.write(key)


@dataclass(frozen=True)
class CertificateInfo:
    """The end of a certificate's validity, and its subject alternative names."""

    until: datetime
    names: tuple[str, ...]


def read_certificates(folder: Path) -> dict[str, CertificateInfo]:
    """Read every ``*.pem`` in ``folder``, by name; raise ``InvalidInput`` or ``InvalidData``."""
    paths = sorted(folder.glob("*.pem"))
    if not paths:
        raise InvalidInput("folder", f"{folder} holds no certificates")
    return {path.name: _info_of(path) for path in paths}


def _info_of(path: Path) -> CertificateInfo:
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise InvalidData(f"{path} is no certificate") from error
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return CertificateInfo(certificate.not_valid_after_utc, ())
    return CertificateInfo(
        certificate.not_valid_after_utc, tuple(str(name.value) for name in names)
    )
