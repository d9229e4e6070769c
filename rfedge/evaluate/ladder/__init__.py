"""``rfedge eval ladder``: what accuracy costs in time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment
from rfedge.samples import sample_path

__all__ = ["EvalLadder"]

LEAST_FRAMES = 3


@dataclass(frozen=True, kw_only=True)
class EvalLadder(Experiment):
    """Measure every rung of the ladder: milliseconds of sender and receiver, bits and quality.

    The result is what `cav-agent --deadline-ms 33 --ladder FILE` chooses from. Prints what it will
    cost before it starts; stopped and started again, it goes on where it was.
    """

    fields: Annotated[tuple[Path, ...], Positional] = (sample_path("fields/street.rff"),)
    """Field archives (.rff) of any kind; rates are relative to the full rung of the first."""
    drive: Path = sample_path("street/transforms_drive_vehicles.json")
    """The drive to code."""
    frames: int = 24
    """Number of its pictures."""
    out: Path = Path("out/eval/ladder.json")
    cells: Path = Path("out/eval/ladder")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.fields:
            raise InvalidInput("fields", "name at least one field")
        if self.frames < LEAST_FRAMES:
            raise InvalidInput("frames", f"{self.frames} must be at least {LEAST_FRAMES}")

    def run(self) -> None:
        """Measure what is not there yet, write the rows, print the front."""
        from rich.console import Console

        from rfedge.arguments import field_source
        from rfedge.evaluate.ladder.run import run_ladder

        job = replace(self, fields=tuple(field_source(name) for name in self.fields))
        run_ladder(job, Console())
