"""``rfedge-lab slice-coder``: our slices against x264's, of the same frames and references."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfedge.samples import sample_path

__all__ = ["EvalSliceCoder"]

SAMPLES = (
    f"empty@10={sample_path('street/transforms_drive_empty.json')}",
    f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}",
)


@dataclass(frozen=True)
class EvalSliceCoder:
    """Compare our slice coder with x264, each frame against the references of a real stream.

    Both code the very same pictures, so nothing but the coders differs. BD-rates of every drive,
    then processor times with the coders taking turns.
    """

    drives: Annotated[tuple[str, ...], Positional] = SAMPLES
    """NAME@HZ=DATASET for each drive; NAME@HZ=DATASET,FIELD.rff for one of another field;
    with ,noise=3 behind it for frames with camera noise of standard deviation 3."""
    field: Path = sample_path("fields/street.rff")
    """The field archive (.rff) of the drives that name none."""
    timed: str = SAMPLES[1]
    """The drive whose frames are timed."""
    sizes: tuple[str, ...] = ("640x360", "1280x720")
    """WIDTHxHEIGHT of the timed frames, each resampled to it; none: no times."""
    threads: tuple[int, ...] = (1,)
    """How many threads all coders run on, one measurement of the times for each."""
    out: Path = Path("out/eval/slice-coder.json")
    """The result file to write."""
    quick: bool = False
    """Four frames of each drive: to see that it works, not for figures."""

    def run(self) -> None:
        """Run everything and write the rows."""
        from rich.console import Console

        from lab.slice_coder.run import SliceCoderJob, run_slice_coder
        from rfedge.arguments import field_path

        job = SliceCoderJob(
            field=field_path(self.field),
            drives=self.drives,
            timed=self.timed,
            sizes=self.sizes,
            out=self.out,
            threads=self.threads,
            quick=self.quick,
        )
        run_slice_coder(job, Console())
