"""``rfedge-lab robust``: what loss, a wrong pose and another light do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment
from rfedge.samples import sample_path

__all__ = ["EvalRobust"]


@dataclass(frozen=True, kw_only=True)
class EvalRobust(Experiment):
    """Send a drive over a lossy link, with noisy poses, and in another light.

    Loss comes in bursts on a datagram link with a virtual clock; every method is compared at one
    total rate, by the SSIM of what a viewer sees. Stopped and started again, it goes on. The
    product sends over TCP: for that, with the link's rate, see `rfedge eval lossy-link`.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    drive: Annotated[str, Positional] = (
        f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"
    )
    """NAME@HZ=DATASET of the drive."""
    dusk: str | None = None
    """NAME@HZ=DATASET of a drive in another light than the field's."""
    lane: str | None = None
    """NAME@HZ=DATASET of a drive in another lane than the training views."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: str = "veryfast"
    """Preset of x264 in the methods compared with."""
    quality_db: float = 33.0
    """Luma PSNR at which bits are compared where nothing is lost."""
    frames: int = 36
    """Number of frames of the drive."""
    seeds: int = 1
    """Number of seeds of loss, for means and their 95 % intervals."""
    rtts_ms: tuple[float, ...] = (20.0, 50.0, 100.0)
    """Round trips of the lossy link."""
    out: Path = Path("out/eval/robust.json")
    cells: Path = Path("out/eval/robust")
    processes: int = 1
    """Number of processes that send at once; the rows do not depend on it."""

    def __post_init__(self) -> None:
        from rfedge.jobs import check_processes

        super().__post_init__()
        check_effort("effort", self.effort)
        if self.frames < 4:
            raise InvalidInput("frames", f"{self.frames} must be at least 4")
        if not 1 <= self.seeds <= 10_000:
            raise InvalidInput("seeds", f"{self.seeds} is outside 1..10,000")
        check_processes(self.processes)
        if not self.rtts_ms or not all(0 <= rtt_ms <= 10_000 for rtt_ms in self.rtts_ms):
            raise InvalidInput("rtts_ms", f"{self.rtts_ms} must be some of 0..10,000 ms")

    def run(self) -> None:
        """Do what is not done yet, write the rows, print what came out."""
        from rich.console import Console

        from lab.robust.run import run_robust
        from rfedge.arguments import field_path

        run_robust(replace(self, field=field_path(self.field)), Console())
