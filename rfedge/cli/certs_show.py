"""``rfedge certs show``: whom certificates name, and how long they are good."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

__all__ = ["CertsShow"]


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
        from rfedge.certs.show import read_certificates

        soon = datetime.now(UTC) + timedelta(days=self.within_days)
        ending = []
        for name, says in read_certificates(self.folder).items():
            print(f"{name}  until {says.until:%Y-%m-%d %H:%M} UTC  {', '.join(says.names)}")
            if says.until <= soon:
                ending.append(name)
        if ending:
            raise InvalidData(f"{', '.join(ending)}: make new ones (rfedge certs init --replace)")
