"""The ``rfedge`` command line.

A verb is one frozen dataclass, its options (their docstrings are the ``--help``), with a ``run``
method. Heavy imports happen inside ``run``, so that ``rfedge --help`` is immediate.
A user's mistake ends in one line on stderr and exit status 2, never in a traceback.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import (
    DisallowNone,
    FlagCreatePairsOff,
    OmitSubcommandPrefixes,
    PositionalMetavarFromFieldName,
    subcommand,
)

from rfcore.errors import RfedgeError
from rfedge.cli.codec import Decode, Encode
from rfedge.cli.demo import Demo
from rfedge.cli.field import Field
from rfedge.cli.localise import Localise
from rfedge.cli.measure import Bench, Eval, LoadTest
from rfedge.cli.render import Render
from rfedge.cli.scene import Scene
from rfedge.cli.services import Certs, Link, Watch
from rfedge.cli.size import Size
from rfedge.cli.train import Train
from rfedge.cli.twin import Twin

__all__ = ["main", "parse"]

Verb = (
    Annotated[Demo, subcommand("demo")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Field, subcommand("field")]
    | Annotated[Encode, subcommand("encode")]
    | Annotated[Decode, subcommand("decode")]
    | Annotated[Localise, subcommand("localise")]
    | Annotated[Link, subcommand("link")]
    | Annotated[LoadTest, subcommand("loadtest")]
    | Annotated[Size, subcommand("size")]
    | Annotated[Scene, subcommand("scene")]
    | Annotated[Watch, subcommand("watch")]
    | Annotated[Twin, subcommand("twin")]
    | Annotated[Certs, subcommand("certs")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Eval, subcommand("eval")]
)

DESCRIPTION = """Distributed radiance fields for edge video: H.264 deltas against a shared render,
from vehicle to roadside server. Start with `rfedge demo`; `rfedge --version` prints the version."""
CONFIG = (
    OmitSubcommandPrefixes,
    DisallowNone,
    FlagCreatePairsOff,
    PositionalMetavarFromFieldName,
)
"""Options are named as their fields, flags have one form, and help shows neither None nor PATH
where a word says more."""


SIGPIPE_STATUS = 141
"""What shells report for a program that was ended by SIGPIPE."""


def parse(arguments: Sequence[str] | None = None) -> Verb:
    """Return the verb that ``arguments`` ask for, by default those of the process.

    Prints help or what is wrong, and raises ``SystemExit``, where they ask for none.
    """
    return tyro.cli(Verb, prog="rfedge", description=DESCRIPTION, args=arguments, config=CONFIG)


def main() -> int:
    """Parse the command line, run one verb, and return its exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a log file gets cost and progress as they come
        sys.stdout.reconfigure(line_buffering=True)
    try:
        return _run()
    except BrokenPipeError as error:
        if not _nobody_reads():
            print(f"rfedge: {error}", file=sys.stderr)
            return 2
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at the exit
        return SIGPIPE_STATUS


def _nobody_reads() -> bool:
    """Return whether standard output is a pipe whose reader, like `head`, has what it wanted."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _run() -> int:
    if sys.argv[1:] == ["--version"]:
        from importlib.metadata import version

        print(f"rfedge {version('rfedge')}")
        return 0
    verb = parse()
    try:
        verb.run()
    except BrokenPipeError:
        raise
    except (RfedgeError, OSError) as error:
        print(f"rfedge: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rfedge: interrupted", file=sys.stderr)
        return 130
    return 0
