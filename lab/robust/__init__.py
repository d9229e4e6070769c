"""``rfedge-lab robust``: what loss, a wrong pose and another light do; ``rfedge-lab seams``: what
tiles do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.samples import sample_path

__all__ = ["EvalRobust", "EvalSeams"]


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


@dataclass(frozen=True)
class EvalSeams:
    """Code a drive across tiles, each of its frames with the tile it is on, and with one field.

    A new tile is a new stream, as a handover is: its first frame has nothing but the render. Bits
    at one quality, near the seams and elsewhere.
    """

    whole: Annotated[Path, Positional]
    """One field (.rff) of all of the street."""
    tiles: Annotated[Path, Positional]
    """The folder of `rfedge dataset split`, with tiles.json."""
    drive: Annotated[str, Positional]
    """NAME@HZ=DATASET of a drive through several tiles."""
    fields: Path = Path("out/tiles")
    """The folder of the tiles' fields, as `rfedge train` of the tiles writes them."""
    within_m: float = 5.0
    """A frame is near a seam if its camera is so near to another tile's ground."""
    quality_db: float = 33.0
    """Luma PSNR at which bits are compared."""
    effort: str = DEFAULT_EFFORT
    """Of our coder: fast, default, thorough."""
    out: Path = Path("out/eval/seams.json")
    """The result file to write."""
    cells: Path = Path("out/eval/seams")
    """Folder of finished pieces."""

    def run(self) -> None:
        """Code what is not there yet, write the rows, print them."""
        from rich.console import Console

        from lab.robust.seams import SeamRow, SeamsJob, print_seams, run_seams
        from rfedge.results import rows_of

        job = SeamsJob(
            whole=self.whole,
            tiles=self.tiles,
            fields=self.fields,
            drive=self.drive,
            within_m=self.within_m,
            quality_db=self.quality_db,
            effort=self.effort,
            out=self.out,
            cells=self.cells,
        )
        print_seams(Console(), rows_of(SeamRow, run_seams(job)["rows"]))
