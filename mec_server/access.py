"""Permissions of consumers and the list of revoked certificates: one file, read again on change.

A certificate states an identity and its role. What a consumer may see is in this file instead of
the certificate, so that it can be changed in a moment, without issuing certificates, and for
streams that are open. ``--access FILE`` (TOML)::

    revoked = ["spiffe://rfedge/vehicle/cav-7", "serial:0x5a31"]

    [consumers.traffic-desk]
    tiles = ["west"]

    [consumers.fleet-owner]
    vehicles = ["cav-1", "cav-2"]

    [consumers.auditor]
    all = true

Without the file consumers see everything; with it, a consumer that it does not name sees nothing. A
vehicle sees its own pictures, an operator all. Fields are for vehicles and operators, and for
consumers those of the tiles they may see. A tile is seen by its field: two tiles of one server that
share a field are seen together.

Without clock or sockets. ``AccessList`` decides, ``Guard`` keeps track of calls that are open.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from rfcore.errors import AccessDenied, InvalidInput, RfedgeError
from rfcore.files import read_regular
from rfcore.wire.tls import PeerIdentity, Role, parse_identity
from rfcore.wire.values import check_name, shown


@dataclass(frozen=True)
class Grant:
    """Permission to see everything, or pictures of some vehicles and pictures in some tiles."""

    everything: bool = False
    vehicles: frozenset[str] = frozenset()
    tiles: frozenset[str] = frozenset()

    def covers(self, vehicle_id: str, tiles: frozenset[str]) -> bool:
        """Whether a picture of ``vehicle_id`` may be seen, whose field belongs to ``tiles``."""
        return self.everything or vehicle_id in self.vehicles or bool(self.tiles & tiles)

    def described(self, published: frozenset[str]) -> str:
        """Return what may be seen where these tiles are published; "" for everything."""
        if self.everything:
            return ""
        here, away = sorted(self.tiles & published), sorted(self.tiles - published)
        seen = [f"vehicle {name}" for name in sorted(self.vehicles)]
        seen += [f"tile {name}" for name in here]
        missing = f" (this server has no tile {', '.join(away)})" if away else ""
        return (", ".join(seen) or "nothing") + missing

    def check_vehicles(self, vehicle_ids: frozenset[str]) -> None:
        """Raise ``AccessDenied`` for vehicles asked for by name that can never be seen."""
        if self.everything or self.tiles:
            return
        denied = sorted(vehicle_ids - self.vehicles)
        if denied or not self.vehicles:
            named = ", ".join(denied) or "any vehicle"
            raise AccessDenied(f"this certificate may not see {named}; ask the operator")


EVERYTHING = Grant(everything=True)


@dataclass(frozen=True)
class AccessList:
    """The contents of an access file; ``consumers`` is None without one."""

    consumers: dict[str, Grant] | None = None
    revoked_uris: frozenset[str] = frozenset()
    revoked_serials: frozenset[int] = frozenset()

    def check(self, identity: PeerIdentity | None, now: datetime) -> None:
        """Raise ``AccessDenied`` for a certificate that is revoked, expired or of no known role."""
        if identity is None:
            return
        identity.role_and_name()
        if self.revoked_uris & set(identity.uris) or identity.serial in self.revoked_serials:
            raise AccessDenied("this certificate is revoked; ask for a new one")
        if identity.until is not None and identity.until <= now:
            raise AccessDenied(f"this certificate expired at {identity.until:%Y-%m-%d %H:%M} UTC")

    def grant(self, identity: PeerIdentity | None) -> Grant:
        """Return what a peer may see; in plaintext everybody sees everything."""
        if identity is None:
            return EVERYTHING
        role, name = identity.role_and_name()
        match role:
            case Role.OPERATOR:
                return EVERYTHING
            case Role.VEHICLE:
                return Grant(vehicles=frozenset({name}))
            case Role.CONSUMER:
                return EVERYTHING if self.consumers is None else self.consumers.get(name, Grant())
            case Role.SERVER | Role.PROXY:
                return Grant()

    def may_fetch(self, identity: PeerIdentity | None, tiles: frozenset[str]) -> bool:
        """Whether a peer may have a field that belongs to ``tiles``."""
        if identity is None or identity.role_and_name()[0] is Role.VEHICLE:
            return True
        grant = self.grant(identity)
        return grant.everything or bool(grant.tiles & tiles)


@dataclass
class AccessFile:
    """An access list that follows its file."""

    path: Path | None
    current: AccessList = field(default_factory=AccessList)
    _seen: tuple[int, int, int] | None = None

    def start(self) -> None:
        """Read the file; raise ``InvalidInput`` if it cannot be used."""
        if self.path is not None:
            self._seen = self._stamp()
            self.current = read_access(self.path)

    def refresh(self) -> bool:
        """Read the file again if it was changed; return whether the list is another one now.

        Not for the event loop: it reads and parses up to ``MAX_ACCESS_BYTES``.

        Raises ``RfedgeError`` once for a file that cannot be used: the list before it stays.
        """
        stamp = self._stamp()
        if self.path is None or stamp == self._seen:
            return False
        self._seen = stamp
        before, self.current = self.current, read_access(self.path)
        return before != self.current

    def _stamp(self) -> tuple[int, int, int] | None:
        if self.path is None:
            return None
        try:
            status = self.path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_ino, status.st_size


MAX_ACCESS_BYTES = 4 << 20


def read_access(path: Path) -> AccessList:
    """Read an access file; raise ``InvalidInput`` naming the file and what is wrong in it."""
    try:
        return _access_of(tomllib.loads(read_regular(path, MAX_ACCESS_BYTES).decode()))
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, RfedgeError) as error:
        raise InvalidInput("access", f"{path}: {error}") from error


def _access_of(table: dict[str, object]) -> AccessList:
    unknown = sorted(set(table) - {"revoked", "consumers"})
    if unknown:
        raise InvalidInput("access", f"{shown(unknown[0])} is neither revoked nor consumers")
    uris, serials = set(), set()
    for entry in _texts("revoked", table.get("revoked", [])):
        if entry.startswith("serial:"):
            serials.add(int(entry.removeprefix("serial:"), 0))
        else:
            parse_identity(entry)
            uris.add(entry)
    consumers = table.get("consumers", {})
    if not isinstance(consumers, dict):
        raise InvalidInput("consumers", "must be tables, as [consumers.NAME]")
    grants = {check_name("consumer", name): _grant(name, of) for name, of in consumers.items()}
    return AccessList(grants, frozenset(uris), frozenset(serials))


def _grant(name: str, table: object) -> Grant:
    if not isinstance(table, dict) or set(table) - {"all", "vehicles", "tiles"}:
        raise InvalidInput(f"consumers.{name}", "may have all, vehicles and tiles")
    everything = table.get("all", False)
    if not isinstance(everything, bool):
        raise InvalidInput(f"consumers.{name}.all", "must be true or false")
    names = {
        key: frozenset(_texts(f"consumers.{name}.{key}", table.get(key, [])))
        for key in ("vehicles", "tiles")
    }
    return Grant(everything, **names)


def _texts(where: str, value: object) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise InvalidInput(where, "must be a list of strings")
    return value
