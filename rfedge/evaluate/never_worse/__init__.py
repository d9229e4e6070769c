"""``rfedge eval never-worse``: what a wrong field, or none, costs against plain x264."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.evaluate.compare import Preset

__all__ = ["EvalNeverWorse"]


@dataclass(frozen=True)
class EvalNeverWorse:
    """Compare with low-delay x264 at 31, 33 and 35 dB: right field, wrong street, black render.

    Prints what it will cost before it starts; stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold."""
    drives: Annotated[tuple[str, ...], Positional] = ()
    """NAME@HZ=DATASET for each drive."""
    decimated: tuple[str, ...] = ()
    """The same for drives of which every fifth frame is taken, at a fifth of the rate."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "veryfast"
    """x264 preset of the anchor."""
    out: Path = Path("out/eval/never-worse.json")
    """The result file to write."""
    cells: Path = Path("out/eval/never-worse")
    """Folder of finished pieces."""
    quick: bool = False
    """Six frames of each drive: to see that it works, not for figures."""
    retime: bool = False
    """Take the processor times anew (on a quiet machine) and keep everything else."""

    def run(self) -> None:
        """Run what is not there yet and write the rows."""
        from rich.console import Console

        from rfedge.arguments import field_path
        from rfedge.evaluate.never_worse.measure import NeverWorseJob, run_never_worse

        job = NeverWorseJob(
            field=field_path(self.field),
            drives=self.drives,
            decimated=self.decimated,
            effort=self.effort,
            preset=self.preset,
            out=self.out,
            cells=self.cells,
            quick=self.quick,
            retime=self.retime,
        )
        run_never_worse(job, Console())
