"""``rfedge eval``: experiments whose results are committed, one module a verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg, subcommand

from rfedge.experiments.compare import EvalCompare
from rfedge.experiments.ladder import EvalLadder
from rfedge.experiments.latency import EvalLatency
from rfedge.experiments.never_worse import EvalNeverWorse
from rfedge.experiments.paper import EvalPaper
from rfedge.experiments.robust import EvalRobust

__all__ = ["Eval"]


@dataclass(frozen=True)
class Eval:
    """Run an experiment; results are JSON with command, revision, host and input digests."""

    verb: Annotated[
        Annotated[EvalCompare, subcommand("compare")]
        | Annotated[EvalLadder, subcommand("ladder")]
        | Annotated[EvalNeverWorse, subcommand("never-worse")]
        | Annotated[EvalLatency, subcommand("latency")]
        | Annotated[EvalPaper, subcommand("paper")]
        | Annotated[EvalRobust, subcommand("robust")],
        arg(name=""),
    ]

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
