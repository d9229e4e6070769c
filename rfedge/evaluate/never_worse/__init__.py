"""``rfedge eval never-worse``: what a wrong field, or none, costs against plain x264."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment, Preset

__all__ = ["EvalNeverWorse"]


@dataclass(frozen=True, kw_only=True)
class EvalNeverWorse(Experiment):
    """Compare with low-delay x264 at 31, 33 and 35 dB: right field, wrong street, black render.

    Prints what it will cost before it starts; stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold."""
    drives: Annotated[tuple[str, ...], Positional] = ()
    """NAME@HZ=DATASET for each drive."""
    decimated: tuple[str, ...] = ()
    """NAME@HZ=DATASET for each drive that is coded at a fifth of its rate: every fifth frame."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "veryfast"
    """x264 preset of the anchor."""
    out: Path = Path("out/eval/never-worse.json")
    cells: Path = Path("out/eval/never-worse")
    retime: bool = False
    """Take the processor times anew (on a quiet machine) and keep everything else."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        if not (self.drives or self.decimated):
            raise InvalidInput("drives", "there is none")

    def run(self) -> None:
        """Run what is not there yet, write the rows and print them."""
        from rich.console import Console

        from rfedge.arguments import field_source
        from rfedge.evaluate.never_worse.measure import run_never_worse

        run_never_worse(replace(self, field=field_source(self.field)), Console())
