"""``rfedge-lab adapt``: what another light than the field's costs, and what wins it back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment, Preset

__all__ = ["EvalAdapt"]


@dataclass(frozen=True, kw_only=True)
class EvalAdapt(Experiment):
    """Compare, at 33 dB, a drive in another light with the noon that the field shows.

    Stopped and started again, it goes on where it was.
    """

    cases: Annotated[tuple[str, ...], Positional, arg(metavar="NAME@HZ=DRIVE,KEY=PATH...")]
    """A drive; then field= (the field both ends hold), noon= (the same drive in the field's light),
    empty= (the same drive without what the field has not seen), and any name with the field or
    layer of another variant, as in learnt=dusk.rff, or learnt:2=dusk.rff if from two passes,
    learnt:3/2=dusk.rff if from three passes of two vehicles."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "medium"
    """Preset of the rival, x264 tuned for PSNR."""
    out: Path = Path("out/eval/adapt.json")
    cells: Path = Path("out/eval/adapt")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        if not self.cases:
            raise InvalidInput("cases", "there is none")

    def run(self) -> None:
        """Code what is not there yet, write the rows and print them."""
        from rich.console import Console

        from lab.adapt.measure import run_adapt

        run_adapt(self, Console())
