"""``rfedge certs``: who may talk to whom. One module a sub-verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from rfedge.cli.certs_init import CertsInit
from rfedge.cli.certs_show import CertsShow

__all__ = ["Certs"]

SubVerb = Annotated[CertsInit, subcommand("init")] | Annotated[CertsShow, subcommand("show")]


@dataclass(frozen=True)
class Certs:
    """Certificates for mec-server, vehicles and consumers."""

    verb: SubVerb

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
