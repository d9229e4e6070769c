"""Measures the tables that ``rfedge size`` ships with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfedge.samples import sample_path

__all__ = ["EvalSizing"]

SAMPLE = f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"


@dataclass(frozen=True)
class EvalSizing:
    """Measure the tables of `rfedge size`: bytes and processor time by size, rate and quality.

    Goes on where it was stopped, cell by cell.
    """

    drives: Annotated[tuple[str, ...], Positional] = (SAMPLE,)
    """NAME@HZ=DATASET for each drive; every second, third and fifth frame stand for slower
    cameras."""
    field: Path = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    sizes: tuple[str, ...] = ("320x180", "640x360", "1920x1080")
    """WIDTHxHEIGHT that the pictures are reduced to, as far as a drive is that large."""
    out: Path = Path("out/eval/sizing.json")
    """The result file to write."""
    cells: Path = Path("out/eval/sizing")
    """Folder of finished pieces."""
    quick: bool = False
    """Five frames at the drives' own rates: to see that it works, not for figures."""

    def run(self) -> None:
        """Run what is not there yet and write the tables."""
        from rich.console import Console

        from rfedge.arguments import field_path, parse_size
        from rfedge.evaluate.clips import DriveName
        from rfedge.sizing.run import SizingJob, run_sizing

        job = SizingJob(
            drives=[DriveName.parse(text) for text in self.drives],
            field=field_path(self.field),
            sizes_px=[parse_size(size) for size in self.sizes],
            out=self.out,
            cells=self.cells,
            quick=self.quick,
        )
        run_sizing(job, Console())
