"""Subjects and messages of servers that share one twin over NATS, and which of two shows a vehicle.

This module knows no NATS client, event loop or clock. A server publishes each reconstructed picture
as TwinService sends it (``WatchResponse`` of twin.proto) on

    rfedge.twin.ENCODING.VEHICLE.CAMERA

where ENCODING is none (poses and ages, always), or jpeg, i420 or png: while somebody asks for it
on ``rfedge.wanted.ENCODING``. A departure goes out on all of them. The header ``Rfedge-Place`` says
which session of which server it belongs to: a ``VehicleLocation`` as JSON. The bucket of keys and
values ``rfedge-places`` holds the same for every vehicle, by name. The object store
``rfedge-fields`` holds archives by field id. A name's dots are ``=`` in subjects and keys.

A vehicle that moves to another server has sessions on both for a moment. The session that was
opened last is the vehicle's; the others are ignored, until they end or nothing was heard of them
for ``EXPIRES_S``. Opening times are those of the servers' clocks: servers whose clocks differ by
more than a vehicle takes to move show it from the older session until that one has ended.
"""

from __future__ import annotations

import json
import ssl
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from rfcore.errors import InvalidInput, ProtocolError
from rfcore.wire.address import Address
from rfcore.wire.twin import PictureEncoding
from rfcore.wire.values import check_field_id, check_name, check_range, shown

PLACES_BUCKET: Final = "rfedge-places"
FIELDS_BUCKET: Final = "rfedge-fields"
PLACE_HEADER: Final = "Rfedge-Place"


def header_bytes(headers: Mapping[str, str]) -> int:
    """Return the bytes of a message's headers, which count against the server's limit of a message.

    nats-py 2.16 compares the body alone with it; a message that exceeds it with its headers costs
    the connection.
    """
    lines = [f"{name}: {value}" for name, value in headers.items()]
    return len("\r\n".join(["NATS/1.0", *lines, "", ""]).encode())


EXPIRES_S: Final = 6.0
"""A session that was silent for this long is over."""
WANTED_EVERY_S: Final = 0.5
"""Period at which a consumer repeats the encoding it wants."""
WANTED_S: Final = 3.0
"""Time for which a server publishes an encoding after the last request."""

MOST_SERVERS: Final = 16
LONGEST_LOGIN_BYTES: Final = 4096
PORT: Final = 4222
SCHEMES: Final = ("nats", "tls")


@dataclass(frozen=True)
class NatsServers:
    """Addresses of NATS servers, and the files that prove who we are.

    ``login`` holds one line, USER:PASSWORD or a token. ``authority`` is the certificate (PEM) that
    signs the servers', by default those of this machine; ``certificate`` and ``key`` are our own.
    Raises ``InvalidInput`` for plaintext that would leave the machine without permission, for
    secrets in a URL, and for files that cannot be used.
    """

    urls: tuple[str, ...]
    login: Path | None = None
    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    allow_insecure: bool = False

    @staticmethod
    def parse_urls(text: str) -> tuple[str, ...]:
        """Return the addresses of ``URL[,URL]``."""
        return tuple(part.strip() for part in text.split(","))

    def __post_init__(self) -> None:
        check_range("nats", len(self.urls), 1, MOST_SERVERS)
        addresses = [self._address(url) for url in self.urls]
        if (self.certificate is None) != (self.key is None):
            raise InvalidInput("nats-cert", "--nats-cert and --nats-key belong together")
        if self.is_secure:
            self.tls_context()
        else:
            for address in addresses:
                address.require_private("nats", self.allow_insecure)
        self.credentials()

    @property
    def is_secure(self) -> bool:
        """Whether the connection is encrypted."""
        has_files = self.authority is not None or self.certificate is not None
        return has_files or any(url.startswith("tls:") for url in self.urls)

    def tls_context(self) -> ssl.SSLContext:
        """Return the context for encrypted connections."""
        try:
            context = ssl.create_default_context(cafile=self.authority)
            if self.certificate is not None:
                context.load_cert_chain(self.certificate, self.key, password="")
        except OSError as error:  # ssl.SSLError, too
            files = ", ".join(str(f) for f in (self.authority, self.certificate, self.key) if f)
            raise InvalidInput("nats-ca", f"{files}: {error.strerror or error}") from error
        return context

    def credentials(self) -> Mapping[str, str]:
        """Return the contents of the login file, as options of the client."""
        if self.login is None:
            return {}
        try:
            line = self.login.read_bytes()[:LONGEST_LOGIN_BYTES].decode().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInput("nats-login", f"{self.login}: {error}") from error
        if not line or "\n" in line:
            raise InvalidInput("nats-login", f"{self.login} must hold one line, USER:PASSWORD")
        user, colon, password = line.partition(":")
        return {"user": user, "password": password} if colon else {"token": line}

    def _address(self, url: str) -> Address:
        try:
            parts = urlsplit(url)
            port = parts.port or PORT
        except ValueError as error:
            raise InvalidInput("nats", f"{shown(url)}: {error}") from error
        if parts.username is not None:
            raise InvalidInput(
                "nats", "a URL shows its secret to everybody; give --nats-login FILE"
            )
        if parts.scheme not in SCHEMES or not parts.hostname or parts.path.strip("/"):
            raise InvalidInput("nats", f"{shown(url)} must be nats://HOST:PORT or tls://HOST:PORT")
        return Address(parts.hostname, port)


@dataclass(frozen=True)
class VehicleLocation:
    """A vehicle's session ``session_id`` on ``server``, in ``tile`` (empty: none is published)
    against ``field_id``. ``opened_time_ns``: when the vehicle said Hello, Unix time of the server;
    ``epoch``: the last one seen of it."""

    vehicle_id: str
    server: str
    session_id: str
    opened_time_ns: int
    epoch: int
    tile: str
    field_id: str

    def __post_init__(self) -> None:
        check_name("place.vehicle_id", self.vehicle_id)
        check_name("place.server", self.server)
        check_name("place.session_id", self.session_id)
        check_range("place.opened_time_ns", self.opened_time_ns, 0, 2**63 - 1)
        check_range("place.epoch", self.epoch, 0, 2**32 - 1)
        if self.tile:
            check_name("place.tile", self.tile)
        check_field_id("place.field_id", self.field_id)

    @property
    def session(self) -> tuple[str, str]:
        """Key of the session among those of all servers."""
        return (self.server, self.session_id)

    @property
    def rank(self) -> tuple[int, int, str, str]:
        """Order of a vehicle's sessions: the highest one shows the vehicle."""
        return (self.opened_time_ns, self.epoch, *self.session)

    def encode(self) -> bytes:
        """Return it as JSON, on one line."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()

    @staticmethod
    def decode(data: bytes) -> VehicleLocation:
        """Return what ``encode`` made; raise ``ProtocolError``."""
        try:
            value: Any = json.loads(data)
            return VehicleLocation(**value)
        except (ValueError, TypeError, InvalidInput) as error:
            raise ProtocolError(f"a server sent an impossible place: {error}") from error


class VehicleLocations:
    """Locations of all vehicles, from the reports of several servers. ``now``: seconds,
    monotonic."""

    def __init__(self) -> None:
        self._heard: dict[str, dict[tuple[str, str], tuple[VehicleLocation, float]]] = {}
        self._ended: dict[tuple[str, str], float] = {}

    def hear(self, place: VehicleLocation, now: float) -> bool:
        """Take in what a server says; return whether the vehicle is there."""
        if place.session in self._ended:
            return False
        self._heard.setdefault(place.vehicle_id, {})[place.session] = (place, now)
        current = self.place_of(place.vehicle_id)
        return current is not None and current.session == place.session

    def end(self, place: VehicleLocation, now: float) -> bool:
        """Forget a session that its server ended; return whether the vehicle was there."""
        current = self.place_of(place.vehicle_id)
        self._ended[place.session] = now
        self._forget(place.vehicle_id, place.session)
        return current is not None and current.session == place.session

    def expire(self, now: float) -> None:
        """Forget sessions that were last heard of more than ``EXPIRES_S`` ago."""
        for vehicle_id, sessions in tuple(self._heard.items()):
            for session, (_, heard_s) in tuple(sessions.items()):
                if now - heard_s > EXPIRES_S:
                    self._forget(vehicle_id, session)
        for session, ended_s in tuple(self._ended.items()):
            if now - ended_s > EXPIRES_S:
                del self._ended[session]

    def place_of(self, vehicle_id: str) -> VehicleLocation | None:
        """Return where a vehicle is, ``None`` if no server says."""
        heard = (place for place, _ in self._heard.get(vehicle_id, {}).values())
        return max(heard, key=lambda place: place.rank, default=None)

    def _forget(self, vehicle_id: str, session: tuple[str, str]) -> None:
        sessions = self._heard.get(vehicle_id, {})
        sessions.pop(session, None)
        if not sessions:
            self._heard.pop(vehicle_id, None)


def key_of(name: str) -> str:
    """Return a name as one token of a subject, and as a key."""
    return name.replace(".", "=")  # no name has a =


def picture_subject(encoding: PictureEncoding, vehicle_id: str, camera_id: str) -> str:
    """Return the subject on which the pictures of a camera are published."""
    return f"rfedge.twin.{encoding}.{key_of(vehicle_id)}.{key_of(camera_id)}"


def pictures_subject(encoding: PictureEncoding, vehicle_id: str | None = None) -> str:
    """Return the subject to subscribe to for a vehicle's pictures, or for those of all."""
    return f"rfedge.twin.{encoding}.{'*' if vehicle_id is None else key_of(vehicle_id)}.*"


def vehicle_of_subject(subject: str) -> str:
    """Return the vehicle that a picture's subject names; raise ``ProtocolError``."""
    parts = subject.split(".")
    if len(parts) != 5:
        raise ProtocolError(f"{shown(subject)} is no subject of pictures")
    return parts[3].replace("=", ".")


def wanted_subject(encoding: PictureEncoding | None) -> str:
    """Return the subject on which an encoding is asked for; ``None`` stands for all of them."""
    return f"rfedge.wanted.{'*' if encoding is None else encoding}"


def wanted_encoding(subject: str) -> PictureEncoding | None:
    """Return the encoding that is asked for on a subject, if this program knows it."""
    try:
        return PictureEncoding(subject.rpartition(".")[2])
    except ValueError:
        return None
