"""``rfedge-lab classes``: quality of vehicles, people, signs and markings at equal bits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.evaluate.compare import Preset

__all__ = ["EvalClasses"]


@dataclass(frozen=True)
class EvalClasses:
    """PSNR of each class of things, ours and low-delay x264's, at equal bits and equal quality.

    Class pictures are those that `streetgen build` puts beside the drive's pictures. Prints what
    it will cost before it starts; stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold, for the drives that name none."""
    drives: Annotated[tuple[str, ...], Positional] = ()
    """NAME@HZ=DATASET for each drive, such as `people@10=out/people/transforms_drive.json`;
    NAME@HZ=DATASET,FIELD.rff for one of another field;
    with `,noise=3` at the end: with a camera's noise of that standard deviation, in code values."""
    at_db: tuple[float, ...] = (33.5,)
    """Luma PSNR of the whole picture. Equal bits are those that ours needs for it."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "medium"
    """x264 preset of the rivals."""
    out: Path = Path("out/eval/classes.json")
    """The result file to write."""
    cells: Path = Path("out/eval/classes")
    """Folder of finished pieces."""
    quick: bool = False
    """Eight frames of each drive: to see that it works, not for figures."""

    def run(self) -> None:
        """Run what is not there yet and write the rows."""
        from rich.console import Console

        from lab.classes.measure import ClassesJob, run_classes
        from rfedge.arguments import field_path

        job = ClassesJob(
            field=field_path(self.field),
            drives=self.drives,
            at_db=self.at_db,
            effort=self.effort,
            preset=self.preset,
            out=self.out,
            cells=self.cells,
            quick=self.quick,
        )
        run_classes(job, Console())
