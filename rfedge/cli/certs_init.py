"""``rfedge certs init``: a certificate authority, and a certificate for everyone it knows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff

__all__ = ["CertsInit"]


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
        from rfedge.certs.folder import write_certificates
        from rfedge.certs.issue import Members, certify

        members = Members(self.vehicles, self.consumers, self.hosts)
        issued = certify(members, datetime.now(UTC), self.days)
        write_certificates(self.out, issued, replace=self.replace)
        for certificate in issued:
            print(f"{self.out / certificate.name}.pem  {certificate.identity}")
        print(f"keep {self.out / 'ca.key'} away from servers and vehicles")
