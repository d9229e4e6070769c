"""``rfedge eval seams``: what it costs to cut a street's field into tiles, where they meet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT

__all__ = ["EvalSeams"]


@dataclass(frozen=True)
class EvalSeams:
    """Code a drive across tiles, each of its frames with the tile it is on, and with one field.

    A new tile is a new stream, as a handover is: its first frame has nothing but the render. Bits
    at one quality, near the seams and elsewhere.
    """

    whole: Annotated[Path, Positional]
    """One field (.rff) of all of the street."""
    tiles: Annotated[Path, Positional]
    """The folder of `rfedge scene split`, with tiles.json."""
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

        from rfedge.experiments.seams.report import SeamRow, print_seams
        from rfedge.experiments.seams.run import SeamsJob, run_seams
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
