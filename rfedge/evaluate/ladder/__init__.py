"""``rfedge eval ladder``: what accuracy costs in time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfedge.samples import sample_path

__all__ = ["EvalLadder"]


@dataclass(frozen=True)
class EvalLadder:
    """Measure every rung of the ladder: milliseconds of sender and receiver, bits and quality.

    The result is what `cav-agent --deadline-ms 33 --ladder FILE` chooses from. Prints what it will
    cost before it starts; stopped and started again, it goes on where it was.
    """

    fields: Annotated[tuple[Path, ...], Positional] = (sample_path("fields/street.rff"),)
    """Field archives (.rff), of any kind; the first one's full rung is what rates are against."""
    drive: Path = sample_path("street/transforms_drive_vehicles.json")
    """The drive to code."""
    frames: int = 24
    """How many of its pictures."""
    out: Path = Path("out/eval/ladder.json")
    """The result file to write."""
    figures: Path = Path("out/eval/figures")
    """Folder of the figure (SVG, and CSV with its numbers)."""
    cells: Path = Path("out/eval/ladder")
    """Folder of finished pieces."""
    quick: bool = False
    """Four frames and few rungs: to see that it works, not for figures."""

    def run(self) -> None:
        """Measure what is not there yet, write rows and figure, print the front."""
        from rich.console import Console

        from rfedge.arguments import field_path
        from rfedge.evaluate.ladder.page import print_front, write_ladder_figure
        from rfedge.evaluate.ladder.run import LadderJob, run_ladder

        console = Console()
        fields = tuple(field_path(name) for name in self.fields)
        job = LadderJob(fields, self.drive, self.out, self.cells, self.frames, self.quick)
        result = run_ladder(job, console)
        print_front(console, result)
        for path in write_ladder_figure(result, self.figures):
            console.print(f"  {path}")
