"""``rfedge certs``: who may talk to whom. One module a sub-verb.

``rfedge certs init``: a certificate authority, and a certificate for everyone it knows.

``rfedge certs show``: whom certificates name, and how long they are good.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, subcommand

__all__ = ["Certs", "CertsInit", "CertsShow"]


@dataclass(frozen=True)
class CertsInit:
    """Make a folder of certificates: an authority, servers, vehicles, consumers of the twin."""

    out: Path = Path("out/certs")
    """The folder to make: ca.pem, server.pem, vehicle-NAME.pem, consumer-NAME.pem, each with its
    .key, which only the owner may read."""
    vehicles: tuple[str, ...] = ("cav-1",)
    """Vehicles; each certificate is good for that name (cav-agent --vehicle) only."""
    consumers: tuple[str, ...] = ("watch",)
    """Who may watch the twin and ask for the server's health, without being a vehicle."""
    hosts: tuple[str, ...] = ("localhost", "127.0.0.1", "::1")
    """Names and addresses by which vehicles reach the server."""
    days: int = 365
    """How long the certificates are good."""
    replace: Annotated[bool, FlagCreatePairsOff] = False
    """Replace the certificates in OUT; those signed before are then worth nothing."""

    def run(self) -> None:
        """Make them and say what is where."""
        from datetime import UTC, datetime

        from rfedge.certs import require_cryptography

        require_cryptography()
        from rfedge.certs.authority import Members, certify, write_certificates

        members = Members(self.vehicles, self.consumers, self.hosts)
        issued = certify(members, datetime.now(UTC), self.days)
        write_certificates(self.out, issued, replace=self.replace)
        for certificate in issued:
            print(f"{self.out / certificate.name}.pem  {certificate.identity}")
        print(f"keep {self.out / 'ca.key'} away from servers and vehicles")


@dataclass(frozen=True)
class CertsShow:
    """Print what each certificate in a folder says; one that is no longer good is an error."""

    folder: Positional[Path] = Path("out/certs")
    """The folder of `rfedge certs init`."""
    within_days: int = 0
    """Also call those an error that run out within so many days."""

    def run(self) -> None:
        """Read, print, judge."""
        from datetime import UTC, datetime, timedelta

        from rfcore.errors import InvalidData
        from rfedge.certs import require_cryptography

        require_cryptography()
        from rfedge.certs.authority import read_certificates

        soon = datetime.now(UTC) + timedelta(days=self.within_days)
        ending = []
        for name, says in read_certificates(self.folder).items():
            print(f"{name}  until {says.until:%Y-%m-%d %H:%M} UTC  {', '.join(says.names)}")
            if says.until <= soon:
                ending.append(name)
        if ending:
            raise InvalidData(f"{', '.join(ending)}: make new ones (rfedge certs init --replace)")


SubVerb = Annotated[CertsInit, subcommand("init")] | Annotated[CertsShow, subcommand("show")]


@dataclass(frozen=True)
class Certs:
    """Certificates for mec-server, vehicles and consumers."""

    verb: SubVerb

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
