"""``rfedge-lab latency``: how long frames take over links."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment
from rfedge.samples import sample_path

__all__ = ["EvalLatency"]

SAMPLES = (
    f"empty@10={sample_path('street/transforms_drive_empty.json')}",
    f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}",
)


@dataclass(frozen=True, kw_only=True)
class EvalLatency(Experiment):
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
    """Effort of our coder: fast, default, thorough; x264-PRESET codes ours with x264, too."""
    preset: str = "veryfast"
    """Preset of x264, which is compared with."""
    quality_db: float = 33.0
    """Luma PSNR that both are coded to."""
    out: Path = Path("out/eval/latency.json")
    cells: Path = Path("out/eval/latency")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        if not 20 <= self.quality_db <= 50:
            raise InvalidInput("quality_db", f"{self.quality_db} dB is outside 20..50 dB")

    def run(self) -> None:
        """Code what is not there yet, play it, write the rows, print what is needed."""
        from rich.console import Console

        from lab.latency.run import run_latency
        from rfedge.arguments import field_path

        run_latency(replace(self, field=field_path(self.field)), Console())
