"""``rfedge-lab latency``: how long frames take over links; ``eval tail``: the largest of many."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.samples import sample_path

__all__ = ["EvalLatency", "EvalTail"]

SAMPLES = (
    f"empty@10={sample_path('street/transforms_drive_empty.json')}",
    f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}",
)


@dataclass(frozen=True)
class EvalLatency:
    """Play our frames and low-delay x264's, of equal quality, over links on a virtual clock.

    Tau and network latency over throughput and over recorded traces, the share of frames within 5
    and 10 ms, and the uplink at which 99 % of them are. Coded clips are kept and not coded again.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    drives: Annotated[tuple[str, ...], Positional] = SAMPLES
    """NAME@HZ=DATASET for each drive."""
    traces: tuple[Path, ...] = (sample_path("links/drive.up"),)
    """Recorded uplinks in Mahimahi's format."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: str = "veryfast"
    """x264 preset of the other."""
    quality_db: float = 33.0
    """Luma PSNR that both are coded to."""
    out: Path = Path("out/eval/latency.json")
    """The result file to write."""
    figures: Path = Path("out/eval/figures")
    """Folder of the figures (SVG, and CSV with their numbers)."""
    cells: Path = Path("out/eval/latency")
    """Folder of finished pieces."""
    quick: bool = False
    """Six frames of each drive: to see that it works, not for figures."""

    def run(self) -> None:
        """Code what is not there yet, play it, write rows and figures, print what is needed."""
        from rich.console import Console

        from lab.latency.report import (
            NeededRow,
            print_needed,
            write_latency_figures,
        )
        from lab.latency.run import LatencyJob, run_latency
        from rfedge.arguments import field_path
        from rfedge.results import rows_of

        job = LatencyJob(
            field=field_path(self.field),
            drives=self.drives,
            traces=self.traces,
            effort=self.effort,
            preset=self.preset,
            quality_db=self.quality_db,
            out=self.out,
            cells=self.cells,
            quick=self.quick,
        )
        console = Console()
        result = run_latency(job, console)
        print_needed(console, rows_of(NeededRow, result["needed"]))
        for path in write_latency_figures(result, self.figures):
            console.print(f"  {path}")


@dataclass(frozen=True)
class EvalTail:
    """Code so many different frames, ours and low-delay x264's, that one late in 100,000 shows.

    No recording is that long. So a field stands for the street: a camera sees its renders with
    noise, from random drives along a recorded path, and both ends hold a lower level of its detail.
    What comes out is how sizes are distributed and which constant uplink carries every frame in
    time.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) that stands for the street; it needs levels of detail."""
    path: Annotated[Path, Positional] = sample_path("street/transforms_drive_empty.json")
    """The data set whose poses are driven along."""
    frames: int = 300_000
    """How many frames, those that begin a drive not counted."""
    size: str = "160x90"
    """WIDTHxHEIGHT px."""
    hz: float = 10.0
    """Pictures per second."""
    detail: float = 0.25
    """Level of the field that both ends hold."""
    noise: float = 2.0
    """Standard deviation of the camera's noise, in levels."""
    quality_db: float = 33.0
    """Luma PSNR that both are coded to, on the first drives."""
    effort: str = DEFAULT_EFFORT
    """Of ours: fast, default, thorough."""
    preset: str = "veryfast"
    """x264 preset of the other."""
    seed: int = 1
    """Of the drives and the noise."""
    processes: int = 1
    """How many work at it."""
    out: Path = Path("out/eval/tail.json")
    """The result file to write."""
    cells: Path = Path("out/eval/tail")
    """Folder of finished pieces."""

    def run(self) -> None:
        """Code what is not there yet, write the rows, print them."""
        from rich.console import Console

        from lab.latency.tail import (
            FieldStreet,
            TailJob,
            TailRow,
            print_tail,
            run_tail,
        )
        from rfedge.arguments import field_path, parse_size
        from rfedge.results import rows_of

        street = FieldStreet(
            field_path(self.field),
            self.path,
            parse_size(self.size),
            self.hz,
            self.detail,
            self.noise,
            self.seed,
        )
        job = TailJob(
            street=street,
            frames=self.frames,
            quality_db=self.quality_db,
            effort=self.effort,
            preset=self.preset,
            processes=self.processes,
            out=self.out,
            cells=self.cells,
        )
        console = Console()
        print_tail(console, rows_of(TailRow, run_tail(job, console)["rows"]))
