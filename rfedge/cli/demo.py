"""``rfedge demo``: the main job, end to end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from rfcore.codec.h264.config import DEFAULT_EFFORT
from rfedge.arguments import DATASET, FOLDER
from rfedge.samples import sample_path

if TYPE_CHECKING:
    from rich.console import Console

    from rfedge.demo import DemoSettings

__all__ = ["Demo"]


@dataclass(frozen=True)
class Demo:
    """Take or train a field, run server, link and vehicle on two drives, and report."""

    sample: Annotated[Path, FOLDER] = sample_path("street")
    """Dataset folder: training views, points, and the drives `empty` and `vehicles`."""
    evening: bool = False
    """Instead: drive at dusk against the field of noon, let the server learn from what it decoded,
    and let a second vehicle fetch and use what it published."""
    dusk: Annotated[Path | None, DATASET] = None
    """With --evening: a drive of the sample's street in another light, as `streetgen build
    street-dusk --split drive` renders it; default: the drive `empty` under a declared light."""
    out: Annotated[Path | None, FOLDER] = None
    """Folder for report.html, result.json and reconstructed.mp4; replaced on every run. Default:
    out/demo, with --evening out/demo-evening."""
    cache: Annotated[Path, FOLDER] = Path("out/cache")
    """Folder that keeps the trained field between runs."""
    train: bool = False
    """Train the field anew; without this, and without settings of your own, the field that ships
    with the sample is used."""
    gaussians: int | None = None
    """At most how many Gaussians to train; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations; default: the trainer's own."""
    rate_hz: float = 10.0
    """Camera frames per second of the drives."""
    link_bps: float = 4e6
    """Throughput of the link in either direction, bit/s."""
    link_delay_ms: float = 20.0
    """One-way delay of the link, ms."""
    effort: Annotated[str, arg(metavar="EFFORT")] = DEFAULT_EFFORT
    """Of the P pictures' coder: fast, default, thorough; x264-PRESET codes them with x264."""
    preset: Annotated[str, arg(metavar="PRESET")] = "medium"
    """x264 preset of what the P pictures are compared with."""
    crf: float = 23.0
    """Quality, x264's constant rate factor, 1 (best) to 51."""
    threads: int = 2
    """Threads of each renderer."""

    def run(self) -> None:
        """Run the demo, write its report and print its table."""
        from rich.console import Console

        from rfcore.errors import InvalidInput
        from rfedge.demo import DemoSettings, run_demo
        from rfedge.demo.report import print_summary, write_report
        from rfedge.training.run import training_config

        if self.dusk is not None and not self.evening:
            raise InvalidInput("dusk", f"{self.dusk} is driven only with --evening; give it, too")
        console = Console()
        settings = DemoSettings(
            sample=self.sample,
            out=self._out,
            cache=self.cache,
            train_anew=self.train,
            training=training_config(self.gaussians, self.iterations, self.threads),
            rate_hz=self.rate_hz,
            link_bps=self.link_bps,
            link_delay_ms=self.link_delay_ms,
            effort=self.effort,
            preset=self.preset,
            crf=self.crf,
            threads=self.threads,
        )
        if self.evening:
            self._run_evening(settings, console)
            return
        run = run_demo(settings, console)
        video = settings.out / "reconstructed.mp4"
        write_report(settings.out / "report.html", run.result, run.pictures, video)
        print_summary(console, run.result, settings.out)
        # Not wrapped to the terminal's width: to be copied in one go.
        print(f"in a browser: {run.twin_command(settings.out)}")
        run.require_complete()

    def _run_evening(self, settings: DemoSettings, console: Console) -> None:
        from rfedge.demo.evening import run_evening
        from rfedge.demo.report import print_evening, write_evening_report

        run = run_evening(settings, self.dusk, console)
        write_evening_report(settings.out / "report.html", run.result, run.pictures)
        print_evening(console, run.result, settings.out)

    @property
    def _out(self) -> Path:
        """The folder of the demo that was asked for."""
        return self.out or Path("out/demo-evening" if self.evening else "out/demo")
