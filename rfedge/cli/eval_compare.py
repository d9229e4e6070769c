"""``rfedge eval compare``: BD-rate against what a user would pick instead."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

__all__ = ["EvalCompare"]

Preset = Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium"]


@dataclass(frozen=True)
class EvalCompare:
    """Compare with low-delay x264, x265 and SVT-AV1 at equal quality, and at equal processor time.

    Prints what it will cost before it starts; stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold."""
    drives: Annotated[tuple[str, ...], Positional]
    """NAME@HZ=DATASET for each drive, such as `yardstick-empty@10=street/transforms_drive.json`."""
    preset: Preset = "veryfast"
    """x264 preset of ours and of the anchor."""
    out: Path = Path("results/compare.json")
    """The result file to write."""
    cells: Path = Path("out/eval/compare")
    """Folder of finished pieces."""
    method: tuple[str, ...] = ()
    """More codecs to compare with, as package.module:Class (see docs/evaluation.md)."""
    quick: bool = False
    """Eight frames and few rivals: to see that it works, not for figures."""

    def run(self) -> None:
        """Run what is not there yet and write the rows."""
        from rich.console import Console

        from rfedge.evaluate.compare_run import CompareJob, run_compare

        job = CompareJob(
            field=self.field,
            drives=self.drives,
            preset=self.preset,
            out=self.out,
            cells=self.cells,
            methods=self.method,
            quick=self.quick,
        )
        run_compare(job, Console())
