"""``rfedge-lab robust``: what loss, a wrong pose and another light do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.samples import sample_path

__all__ = ["EvalRobust"]


@dataclass(frozen=True)
class EvalRobust:
    """Send a drive over a lossy link, with noisy poses, and in another light.

    Loss comes in bursts on a datagram link with a virtual clock; every method is compared at one
    total rate, by the SSIM of what a viewer sees. Stopped and started again, it goes on.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    drive: Annotated[str, Positional] = (
        f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"
    )
    """NAME@HZ=DATASET of the drive."""
    dusk: str | None = None
    """NAME@HZ=DATASET of a drive in another light than the field's."""
    lane: str | None = None
    """NAME@HZ=DATASET of a drive in another lane than the training views."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: str = "veryfast"
    """x264 preset of the others."""
    quality_db: float = 33.0
    """Luma PSNR at which bits are compared where nothing is lost."""
    frames: int = 36
    """How many frames of the drive."""
    seeds: int = 1
    """How many seeds of loss: means, and their 95 % intervals."""
    rtts_ms: tuple[float, ...] = (20.0, 50.0, 100.0)
    """Round trips of the lossy link."""
    out: Path = Path("out/eval/robust.json")
    """The result file to write."""
    figures: Path = Path("out/eval/figures")
    """Folder of the figure (SVG, and CSV with its numbers)."""
    cells: Path = Path("out/eval/robust")
    """Folder of finished pieces."""
    processes: int = 1
    """How many processes send at once; the rows do not depend on it."""
    quick: bool = False
    """Eight frames and the extremes alone: to see that it works, not for figures."""

    def run(self) -> None:
        """Do what is not done yet, write rows and figure, print what came out."""
        from rich.console import Console

        from lab.robust.report import print_robust, write_robust_figure
        from lab.robust.run import RobustJob, run_robust
        from rfedge.arguments import field_path

        job = RobustJob(
            field=field_path(self.field),
            drive=self.drive,
            dusk=self.dusk,
            lane=self.lane,
            effort=self.effort,
            preset=self.preset,
            quality_db=self.quality_db,
            frames=self.frames,
            out=self.out,
            cells=self.cells,
            quick=self.quick,
            seeds=self.seeds,
            rtts_ms=self.rtts_ms,
            processes=self.processes,
        )
        console = Console()
        result = run_robust(job, console)
        print_robust(console, result)
        for path in write_robust_figure(result, self.figures):
            console.print(f"  {path}")
