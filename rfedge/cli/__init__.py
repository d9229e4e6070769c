"""The ``rfedge`` command line: one frozen dataclass a verb (``rfcore.program``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tyro.conf import subcommand

from rfcore.program import parse_options, run_program
from rfedge.cli.codec import Decode, Encode
from rfedge.cli.dataset import Dataset
from rfedge.cli.doctor import Doctor
from rfedge.cli.field import Field
from rfedge.cli.localise import Localise
from rfedge.cli.measure import Eval, LoadTest
from rfedge.cli.render import Render
from rfedge.cli.services import Certs, Watch
from rfedge.cli.size import Size
from rfedge.cli.twin import Twin
from rfedge.demo import Demo
from rfedge.link import LinkSettings
from rfedge.training import Train

__all__ = ["main", "parse"]

Verb = (
    Annotated[Demo, subcommand("demo")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Field, subcommand("field")]
    | Annotated[Encode, subcommand("encode")]
    | Annotated[Decode, subcommand("decode")]
    | Annotated[Localise, subcommand("localise")]
    | Annotated[LinkSettings, subcommand("link")]
    | Annotated[LoadTest, subcommand("loadtest")]
    | Annotated[Size, subcommand("size")]
    | Annotated[Dataset, subcommand("dataset")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Watch, subcommand("watch")]
    | Annotated[Twin, subcommand("twin")]
    | Annotated[Certs, subcommand("certs")]
    | Annotated[Eval, subcommand("eval")]
)

DESCRIPTION = """Distributed radiance fields for edge video: H.264 deltas against a shared render,
from vehicle to roadside server. Start with `rfedge demo`; `rfedge --version` prints the version."""


def parse(arguments: Sequence[str] | None = None) -> Verb:
    """Return the verb that ``arguments`` ask for, by default those of the process.

    Prints help or what is wrong, and raises ``SystemExit``, where they ask for none.
    """
    verb: Verb = parse_options(Verb, "rfedge", arguments, DESCRIPTION)
    return verb


def main() -> int:
    """Parse the command line, run one verb, and return its exit status."""
    return run_program("rfedge", lambda: parse().run())
