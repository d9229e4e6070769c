"""The commands behind ``make sample`` and ``make sample-field``."""

from __future__ import annotations

import sys
from typing import Protocol

import tyro

from rfcore.errors import RfedgeError

__all__ = ["Maker", "run_maker"]


class Maker(Protocol):
    """A command: its fields are options."""

    def run(self) -> None:
        """Do it; raise ``RfedgeError`` or ``OSError``."""


def run_maker(kind: type[Maker], prog: str) -> int:
    """Parse the command line and run the command; return the exit status, 2 after an error."""
    try:
        tyro.cli(kind, prog=prog).run()
    except (RfedgeError, OSError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    return 0
