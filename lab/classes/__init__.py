"""``rfedge-lab classes``: quality of vehicles, people, signs and markings at equal bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment, Preset

__all__ = ["EvalClasses"]


@dataclass(frozen=True, kw_only=True)
class EvalClasses(Experiment):
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
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: Preset = "medium"
    """x264 preset of the rivals."""
    out: Path = Path("out/eval/classes.json")
    cells: Path = Path("out/eval/classes")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        if not self.drives:
            raise InvalidInput("drives", "there is none")
        if not self.at_db or not all(0 < db < 100 for db in self.at_db):
            raise InvalidInput("at_db", f"{self.at_db} are not decibels within 0..100")

    def run(self) -> None:
        """Run what is not there yet, write the rows and print them."""
        from rich.console import Console

        from lab.classes.measure import run_classes
        from rfedge.arguments import field_path

        run_classes(replace(self, field=field_path(self.field)), Console())
