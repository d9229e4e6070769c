"""``rfedge eval``: experiments whose results are committed, one module a verb."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import subcommand

from rfedge.cli.eval_compare import EvalCompare
from rfedge.cli.eval_ladder import EvalLadder
from rfedge.cli.eval_latency import EvalLatency
from rfedge.cli.eval_never_worse import EvalNeverWorse
from rfedge.cli.eval_paper import EvalPaper
from rfedge.cli.eval_robust import EvalRobust
from rfedge.cli.eval_stability import EvalStability

__all__ = ["Eval"]


@dataclass(frozen=True)
class Eval:
    """Run an experiment; results are JSON with command, revision, host and input digests."""

    verb: (
        Annotated[EvalCompare, subcommand("compare")]
        | Annotated[EvalLadder, subcommand("ladder")]
        | Annotated[EvalNeverWorse, subcommand("never-worse")]
        | Annotated[EvalLatency, subcommand("latency")]
        | Annotated[EvalPaper, subcommand("paper")]
        | Annotated[EvalRobust, subcommand("robust")]
        | Annotated[EvalStability, subcommand("stability")]
    )

    def run(self) -> None:
        """Run the verb."""
        self.verb.run()
