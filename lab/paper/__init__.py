"""``rfedge-lab paper``: the published experiment, as published."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["EvalPaper"]


@dataclass(frozen=True)
class EvalPaper:
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
    """The result file to write."""
    figures: Path = Path("out/eval/figures")
    """Folder of the figures (SVG, and CSV with their numbers)."""
    cells: Path = Path("out/eval/paper")
    """Folder of finished pieces."""
    every: int = 1
    """Take each so many-th frame of a drive; neighbours at 10 Hz show almost the same."""
    processes: int = 1
    """How many processes code at once; the rows do not depend on it."""
    quick: bool = False
    """Two frames of each drive: to see that it works, not for figures."""

    def run(self) -> None:
        """Run what is not there yet, write rows and figures, print the means."""
        from rich.console import Console

        from lab.paper.figures import write_paper_figures, write_views
        from lab.paper.report import paper_rows, print_means
        from lab.paper.run import PaperJob, run_paper, views_of
        from rfedge.arguments import parse_size

        sizes_px = tuple(parse_size(size) for size in self.sizes)
        job = PaperJob(
            fields=self.fields,
            drives=self.drives,
            sizes_px=sizes_px,
            out=self.out,
            cells=self.cells,
            every=self.every,
            quick=self.quick,
            processes=self.processes,
        )
        console = Console()
        result = run_paper(job, console)
        rows = paper_rows(result)
        print_means(console, rows)
        written = write_paper_figures(rows, self.figures)
        for path in [*written, *write_views(views_of(job), self.figures)]:
            console.print(f"  {path}")
