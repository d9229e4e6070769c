"""``rfedge demo``: a vehicle, a link and a roadside server as processes, on the sample drives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.arguments import FOLDER
from rfedge.samples import sample_path

__all__ = ["Demo"]


@dataclass(frozen=True)
class Demo:
    """Take or train a field, run a server, a link and a vehicle on two drives, and report."""

    sample: Annotated[Path, FOLDER] = sample_path("street")
    """Dataset folder: training views, points, and the drives `empty` and `vehicles`."""
    out: Annotated[Path, FOLDER] = Path("out/demo")
    """Folder for report.html, result.json and reconstructed.mp4; replaced on every run."""
    cache: Annotated[Path, FOLDER] = Path("out/cache")
    """Folder that keeps the trained field between runs."""
    train: bool = False
    """Train the field anew. Otherwise the field that ships with the sample is used, unless you
    change --gaussians or --iterations."""
    gaussians: int | None = None
    """Largest number of Gaussians to train; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations; default: the trainer's own."""
    rate_hz: float = 10.0
    """Camera frames per second of the drives."""
    link_bps: float = 4e6
    """Throughput of the link in each direction, bit/s."""
    link_delay_ms: float = 20.0
    """One-way delay of the link, ms."""
    effort: Annotated[str, arg(metavar="EFFORT")] = DEFAULT_EFFORT
    """Effort of the P-picture coder: fast, default or thorough; x264-PRESET codes with x264."""
    preset: Annotated[str, arg(metavar="PRESET")] = "medium"
    """x264 preset of the encoders that the P pictures are compared with."""
    crf: float = 23.0
    """Quality as x264's constant rate factor, 1 (best) to 51."""
    threads: int = 2
    """Threads of each renderer."""

    def run(self) -> None:
        """Run the demo, write its report and print its table."""
        from rich.console import Console

        from rfedge.demo.report import print_summary, write_report
        from rfedge.demo.run import run_demo

        console = Console()
        run = run_demo(self, console)
        video = self.out / "reconstructed.mp4"
        write_report(self.out / "report.html", run.result, run.pictures, video)
        print_summary(console, run.result, self.out)
        # Not wrapped to the terminal's width: to be copied in one go.
        print(f"in a browser: {run.twin_command(self.out)}")
        run.require_complete()
