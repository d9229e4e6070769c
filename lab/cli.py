"""The ``rfedge-lab`` command line: one frozen dataclass an experiment (``rfcore.program``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from tyro.conf import subcommand

from lab.adapt import EvalAdapt
from lab.bench import Bench
from lab.benchmark import EvalBenchmark
from lab.city import PlanCity
from lab.classes import EvalClasses
from lab.cold_start import EvalColdStart
from lab.detect import EvalDetect
from lab.head import EvalHead
from lab.intra_size import EvalIntraSize
from lab.latency import EvalLatency
from lab.live import EvalLive
from lab.localisation import EvalLocalise
from lab.localisation.pose_feed import MakeFeed
from lab.paper import EvalPaper
from lab.rig import EvalRig
from lab.robust import EvalRobust
from lab.servers import EvalScale
from lab.size_tables import EvalSizing
from lab.tcp import EvalTcp
from lab.truth import EvalLiveTruth
from lab.webrtc import EvalWebrtc
from lab.world import EvalWorld
from rfcore.program import parse_options, run_program

Verb = (
    Annotated[EvalAdapt, subcommand("adapt")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[EvalBenchmark, subcommand("benchmark")]
    | Annotated[PlanCity, subcommand("city")]
    | Annotated[EvalClasses, subcommand("classes")]
    | Annotated[EvalColdStart, subcommand("cold-start")]
    | Annotated[EvalDetect, subcommand("detect")]
    | Annotated[MakeFeed, subcommand("feed")]
    | Annotated[EvalHead, subcommand("head")]
    | Annotated[EvalIntraSize, subcommand("intra-size")]
    | Annotated[EvalLatency, subcommand("latency")]
    | Annotated[EvalLive, subcommand("live")]
    | Annotated[EvalLiveTruth, subcommand("live-truth")]
    | Annotated[EvalLocalise, subcommand("localise")]
    | Annotated[EvalPaper, subcommand("paper")]
    | Annotated[EvalRig, subcommand("rig")]
    | Annotated[EvalRobust, subcommand("robust")]
    | Annotated[EvalScale, subcommand("scale")]
    | Annotated[EvalSizing, subcommand("size-tables")]
    | Annotated[EvalTcp, subcommand("tcp")]
    | Annotated[EvalWebrtc, subcommand("webrtc")]
    | Annotated[EvalWorld, subcommand("world")]
)


DESCRIPTION = "Experiments whose results are recorded in lab/results."


def parse(arguments: Sequence[str] | None = None) -> Verb:
    """Return the experiment that ``arguments`` ask for, by default those of the process."""
    verb: Verb = parse_options(Verb, "rfedge-lab", arguments, DESCRIPTION)
    return verb


def main() -> int:
    """Run one experiment and return its exit status."""
    return run_program("rfedge-lab", lambda: parse().run())
