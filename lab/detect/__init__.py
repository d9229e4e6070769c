"""``rfedge-lab detect``: what a detector sees in the pictures that arrive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.codec.h264.qp_map import QP_OFFSET_RANGE
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment, Preset

__all__ = ["EvalDetect"]


@dataclass(frozen=True, kw_only=True)
class EvalDetect(Experiment):
    """Average precision of a detector on decoded pictures, ours and low-delay x264's.

    By COCO's rules, against the detector's own boxes on the uncompressed pictures and, where class
    pictures of `streetgen build` lie beside a drive, against what is there. At equal bits, and as
    a BD-rate over the average precision. Ours also with finer quantisers where objects are.
    Stopped and started again, it goes on where it was.
    """

    field: Annotated[Path, Positional]
    """The field archive (.rff) both ends hold, for the drives that name none."""
    drives: Annotated[tuple[str, ...], Positional] = ()
    """NAME@HZ=DATASET for each drive; NAME@HZ=DATASET,FIELD.rff for one of another field."""
    detector: Path
    """The detector (.onnx), run by OpenCV."""
    adapter: str = "fastestdet"
    """How pictures are given to it and boxes taken from it: fastestdet, or MODULE:CLASS of your own
    (docs/how-to/perception.md)."""
    at_db: float = 33.5
    """Luma PSNR of the whole picture. Equal bits are those that ours needs for it."""
    mask_qp: int = -4
    """Added to the quantiser where the masks say that objects are."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough."""
    preset: Preset = "medium"
    """x264 preset of the rivals."""
    out: Path = Path("out/eval/detect.json")
    cells: Path = Path("out/eval/detect")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        if not self.drives:
            raise InvalidInput("drives", "there is none")
        if not 0 < self.at_db < 100:
            raise InvalidInput("at_db", f"{self.at_db:g} is not within 0..100 dB")
        if not QP_OFFSET_RANGE[0] <= self.mask_qp < 0:
            raise InvalidInput("mask_qp", f"{self.mask_qp} is not within {QP_OFFSET_RANGE[0]}..-1")

    def run(self) -> None:
        """Run what is not there yet, write the rows and print them."""
        from rich.console import Console

        from lab.detect.measure import run_detect
        from rfedge.arguments import field_path

        run_detect(replace(self, field=field_path(self.field)), Console())
