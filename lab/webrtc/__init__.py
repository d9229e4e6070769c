"""``rfedge-lab webrtc``: the same camera, link and screen through WebRTC and through us."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from rfcore.codec.h264.config import DEFAULT_EFFORT, check_effort
from rfcore.errors import InvalidInput
from rfedge.evaluate import Experiment
from rfedge.samples import sample_path

__all__ = ["EvalWebrtc"]

PEERS = ("libwebrtc-av1", "libwebrtc-vp8", "libwebrtc-vp9", "aiortc-h264", "aiortc-vp8")


@dataclass(frozen=True, kw_only=True)
class EvalWebrtc(Experiment):
    """Send a camera over IP links by WebRTC and by us, at equal quality; needs root and two cores.

    First each peer, which chooses its rate and with it its quality; then we, at the CRF that gives
    that quality. Senders have the first core, receivers the second. Stopped and started again, it
    goes on. `pip install aiortc wrtc` installs the peers.
    """

    field: Annotated[Path, Positional] = sample_path("fields/street.rff")
    """The field archive (.rff) both of our ends hold."""
    drive: Annotated[str, Positional] = (
        f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"
    )
    """NAME@HZ=DATASET of the drive, a transforms.json."""
    peers: tuple[str, ...] = ("libwebrtc-av1", "libwebrtc-vp8", "aiortc-h264")
    """Engines and their codecs; libwebrtc-vp9 and aiortc-vp8 are there, too."""
    rates_mbps: tuple[float, ...] = (0.3, 1.0, 4.0)
    """Rates of the link."""
    step_mbps: tuple[float, float] | None = (2.0, 0.5)
    """Rates of one more link, without loss, in the first and second half; None: no such link."""
    rtts_ms: tuple[float, ...] = (20.0, 200.0)
    """Round trips without queue."""
    losses: tuple[float, ...] = (0.0, 1.0, 5.0)
    """IP packets lost in either direction, percent."""
    settle_s: float = 8.0
    """Seconds before the measured ones, in which senders find the link's rate."""
    seconds: float = 20.0
    """Measured seconds of each cell."""
    delay_ms: float = 300.0
    """Our --max-delay-ms, beside the round trip."""
    effort: str = DEFAULT_EFFORT
    """Effort of our coder: fast, default, thorough."""
    out: Path = Path("out/eval/webrtc.json")
    cells: Path = Path("out/eval/webrtc")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_effort("effort", self.effort)
        for peer in self.peers:
            if peer not in PEERS:
                raise InvalidInput("peers", f"{peer!r} is none of {', '.join(PEERS)}")
        rates = (*self.rates_mbps, *(self.step_mbps or ()))
        if not rates or not all(0.1 <= rate <= 100 for rate in rates):
            raise InvalidInput("rates_mbps", f"{rates} must be some of 0.1..100")
        if not all(0 <= rtt_ms <= 2000 for rtt_ms in self.rtts_ms):
            raise InvalidInput("rtts_ms", f"{self.rtts_ms} must be some of 0..2000 ms")
        if not all(0 <= loss <= 20 for loss in self.losses):
            raise InvalidInput("losses", f"{self.losses} must be some of 0..20 %")
        for name in ("settle_s", "seconds"):
            if not 2 <= getattr(self, name) <= 3600:
                raise InvalidInput(name, f"{getattr(self, name):g} is outside 2..3600 s")

    def run(self) -> None:
        """Do what is not done yet, write the rows, print what came out."""
        from rich.console import Console

        from lab.webrtc.run import run_webrtc
        from rfedge.arguments import field_path

        run_webrtc(replace(self, field=field_path(self.field)), Console())
