"""``rfedge-lab paper``: the published experiment, as published."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import InvalidInput
from rfedge.arguments import parse_size
from rfedge.evaluate import Experiment

__all__ = ["EvalPaper"]


@dataclass(frozen=True, kw_only=True)
class EvalPaper(Experiment):
    """Code render and camera as the published two-frame clip, over presets, CRFs and sizes.

    One frame a second, default tune, the same CRF for both: the published metric and its controls,
    apart from our own coding. Prints what it will cost, resumes frame by frame.
    """

    fields: tuple[str, ...]
    """NAME=FIELD.rff for each field, such as 3dgs=street.rff ingp=street-ngp.rff."""
    drives: tuple[str, ...]
    """SCENE=DATASET for each drive."""
    sizes: tuple[str, ...] = ("300x168", "500x280", "640x360")
    """Sizes that render and camera are reduced to, and rendered at."""
    out: Path = Path("out/eval/paper.json")
    figures: Path = Path("out/eval/figures")
    """Folder of the picture that shows the fields beside the camera (SVG)."""
    cells: Path = Path("out/eval/paper")
    every: int = 1
    """Take every Nth frame of a drive; neighbours at 10 Hz show almost the same."""
    lpips_weights: Path | None = None
    """Folder of LPIPS's weights (`make lpips-weights` makes `out/lpips`); needs
    rfedge[reference]."""
    processes: int = 1
    """Number of processes that code at once; the rows do not depend on it."""

    def __post_init__(self) -> None:
        from rfedge.jobs import check_processes

        super().__post_init__()
        if not (self.fields and self.drives and self.sizes_px):
            raise InvalidInput("paper", "needs at least one field, one drive and one size")
        check_processes(self.processes)
        if self.every < 1:
            raise InvalidInput("every", f"{self.every} must be at least 1")

    @property
    def sizes_px(self) -> list[tuple[int, int]]:
        """Width and height of each size; raises ``InvalidInput`` for text of another form."""
        return [parse_size(size) for size in self.sizes]

    def run(self) -> None:
        """Run what is not there yet, write the rows and the picture, print the means."""
        from rich.console import Console

        from lab.paper.figures import write_views
        from lab.paper.run import run_paper, views_of

        console = Console()
        run_paper(self, console)
        for path in write_views(views_of(self), self.figures):
            console.print(f"  {path}")
