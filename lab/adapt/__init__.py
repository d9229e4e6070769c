"""``rfedge-lab adapt``: what another light than the field's costs, and what wins it back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.arguments import JSON
from rfedge.evaluate.compare import Preset

__all__ = ["EvalAdapt"]


@dataclass(frozen=True)
class EvalAdapt:
    """Compare, at 33 dB, a drive in another light with the noon that the field shows.

    Stopped and started again, it goes on where it was.
    """

    cases: Annotated[tuple[str, ...], Positional, arg(metavar="NAME@HZ=DRIVE,KEY=PATH...")]
    """A drive; then field= (the field both ends hold), noon= (the same drive in the field's light),
    empty= (the same drive without what the field has not seen), and any name with the field or
    layer of another variant, as in learnt=dusk.rff, or learnt:2=dusk.rff if from two passes,
    learnt:3/2=dusk.rff if from three passes of two vehicles."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "medium"
    """Preset of the rival, x264 tuned for PSNR."""
    out: Annotated[Path, JSON] = Path("out/eval/adapt.json")
    """The result file to write."""
    cells: Path = Path("out/eval/adapt")
    """Folder of finished pieces."""
    quick: bool = False
    """Six frames of each drive: to see that it works, not for figures."""

    def run(self) -> None:
        """Code what is not there yet and write the rows."""
        from rich.console import Console

        from lab.adapt.measure import AdaptCase, AdaptJob, run_adapt

        cases = tuple(AdaptCase.parse(text) for text in self.cases)
        job = AdaptJob(cases, self.effort, self.preset, self.out, self.cells, self.quick)
        run_adapt(job, Console())
