"""``rfedge eval lossy-link``: what a link that is thin and loses packets does to a drive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment
from rfedge.samples import sample_path

__all__ = ["EvalLossyLink"]


@dataclass(frozen=True, kw_only=True)
class EvalLossyLink(Experiment):
    """Send a drive over links of several rates and losses: age, frozen share, quality.

    The vehicle's own session and rate control send over the model of TCP that `rfedge link --loss`
    has, on a virtual clock: the figures do not depend on how busy this machine is.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    drive: Annotated[str, Positional] = (
        f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"
    )
    """NAME@HZ=DATASET of the drive, which is played forth and back."""
    rates_mbps: tuple[float, ...] = (0.5, 2.0)
    """Rates of the uplink; the downlink has the same."""
    losses: tuple[float, ...] = (0.0, 1.0, 5.0)
    """Packets lost in either direction, percent."""
    loss_burst: float = 1.0
    """Packets lost in a row, on average."""
    rtt_ms: float = 40.0
    """Round trip without queue."""
    max_delay_ms: float = 500.0
    """Bound on the delay that the vehicle keeps by its quality, as of `cav-agent`."""
    seconds: float = 20.0
    """Length of the drive; its first three seconds are not counted."""
    vehicle_ms: float = 40.0
    """Time that the vehicle takes for a picture."""
    server_ms: float = 25.0
    """Time that the server takes for one."""
    seed: int = 1
    """Seed of the first drive's losses."""
    seeds: int = 3
    """Drives over each link that loses packets, each with losses of its own; the table has the
    median and the range."""
    out: Path = Path("out/eval/lossy-link.json")
    cells: Path = Path("out/eval/lossy-link")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rates_mbps or not all(0.05 <= rate <= 1000 for rate in self.rates_mbps):
            raise InvalidInput("rates_mbps", f"{self.rates_mbps} must be some of 0.05..1000")
        if not self.losses or not all(0 <= loss <= 30 for loss in self.losses):
            raise InvalidInput("losses", f"{self.losses} must be some of 0..30 %")
        if not 1 <= self.seeds <= 1000:
            raise InvalidInput("seeds", f"{self.seeds} is outside 1..1000")
        if not 1 <= self.rtt_ms <= 2000:
            raise InvalidInput("rtt_ms", f"{self.rtt_ms} is outside 1..2000 ms")
        if not 5 <= self.seconds <= 3600:
            raise InvalidInput("seconds", f"{self.seconds} is outside 5..3600 s")

    def run(self) -> None:
        """Drive over every link that is not there yet, write the rows and print them."""
        from rich.console import Console

        from rfedge.arguments import field_path
        from rfedge.evaluate.lossy_link.measure import run_lossy_link

        run_lossy_link(replace(self, field=field_path(self.field)), Console())
