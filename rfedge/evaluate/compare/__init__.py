"""``rfedge eval compare``: BD-rate against what a user would pick instead."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment, Preset

__all__ = ["EvalCompare"]


@dataclass(frozen=True, kw_only=True)
class EvalCompare(Experiment):
    """Compare with low-delay x264, x265 and SVT-AV1 at equal quality, and at equal processor time.

    Prints what it will cost before it starts; stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold, for the drives that name none."""
    drives: Annotated[tuple[str, ...], Positional] = ()
    """NAME@HZ=DATASET for each drive, such as `yardstick-empty@10=street/transforms_drive.json`;
    NAME@HZ=DATASET,FIELD.rff for one of another field;
    with `,noise=3` at the end: with a camera's noise of that standard deviation, in code values."""
    decimated: tuple[str, ...] = ()
    """NAME@HZ=DATASET for each drive that is coded at a fifth of its rate: every fifth frame."""
    background: tuple[str, ...] = ()
    """NAME@HZ=DATASET with the empty street of a drive, frame by frame at its poses: tells what is
    not in the field, for the split of the bits and for a rival that sends only the foreground."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "veryfast"
    """x264 preset of the anchor."""
    out: Path = Path("out/eval/compare.json")
    cells: Path = Path("out/eval/compare")
    method: tuple[str, ...] = ()
    """More codecs to compare with, as package.module:Class (docs/how-to/compare.md)."""
    rivals: tuple[str, ...] = ()
    """Compare with these rivals only, such as x264-our-tools-medium, and by PSNR only. Another
    name lists them. x264-lowdelay-psnr is added: a field's own bytes are counted against it."""
    window: tuple[float, float] | None = None
    """Lowest and highest luma PSNR to compare over, in dB; 32 35 (and 30 35 where all reach it) if
    not given. Curves are coded at more points until they span it."""
    retime: bool = False
    """Take the processor times anew (on a quiet machine) and keep everything else."""
    processes: int = 1
    """Number of processes that code at once; processor times are taken afterwards, one at a time,
    and the rows do not depend on it."""
    ray: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Code what is not there yet on the Ray cluster at this address (`local` starts one here;
    docs/how-to/servers.md). Processor times are taken here afterwards, and the rows are the same.
    Needs rfedge[ray]."""
    lpips_weights: Path | None = None
    """Folder of LPIPS's weights (`make lpips-weights` makes `out/lpips`): LPIPS by AlexNet of every
    decoded picture too, with a BD-rate of its own. Half a second a picture; needs
    rfedge[reference]."""
    figures: Path | None = None
    """Folder for the curves as SVG, with their numbers as CSV."""

    def __post_init__(self) -> None:
        from rfedge.jobs import check_processes

        super().__post_init__()
        check_processes(self.processes)
        check_effort("effort", self.effort)
        if not (self.drives or self.decimated):
            raise InvalidInput("drives", "there is none")
        if self.quick and self.background:
            raise InvalidInput("background", "is for the split of the bits; run without --quick")
        if self.window is not None:
            low_db, high_db = self.window
            if not 0 < low_db < high_db < math.inf:
                raise InvalidInput("window", f"{low_db:g} {high_db:g} are not two rising decibels")

    def run(self) -> None:
        """Run what is not there yet, write the rows and print them."""
        from rich.console import Console

        from rfcore.extras import require
        from rfedge.arguments import field_source
        from rfedge.evaluate.compare.run import run_compare

        if self.ray is not None:
            require("ray", "ray")
        if self.lpips_weights is not None:
            require("reference", "torch")
        console = Console()
        result = run_compare(replace(self, field=field_source(self.field)), console)
        if self.figures is not None:
            from rfedge.evaluate.compare.figures import write_compare_figures

            for path in write_compare_figures(result, self.figures):
                console.print(f"  {path}")
