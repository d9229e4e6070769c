"""``rfedge-lab tcp``: the model of TCP over lost packets beside this machine's kernel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfcore.errors import InvalidInput

__all__ = ["EvalTcp"]


@dataclass(frozen=True)
class EvalTcp:
    """Send the same over `rfedge link`'s model and over this machine's kernel; needs root.

    The kernel's CUBIC sends between two network namespaces; a wire delays and limits its packets,
    and nft drops them at random in both directions. Ten times as long is sent over the model.
    """

    rates_mbps: tuple[float, ...] = (2.0, 8.0)
    """Rates of the link."""
    losses: tuple[float, ...] = (0.0, 1.0, 2.0, 5.0)
    """Packets lost in either direction, percent."""
    rtt_ms: float = 40.0
    """Round trip without queue."""
    seconds: float = 60.0
    """Time of sending for each cell, first as much as passes, then messages."""
    size: int = 7000
    """Bytes of a message."""
    hz: float = 5.0
    """Messages per second of each connection."""
    connections: int = 4
    """Number of connections that send messages."""
    out: Path = Path("out/eval/tcp.json")

    def __post_init__(self) -> None:
        if not self.rates_mbps or not all(0.1 <= rate <= 100 for rate in self.rates_mbps):
            raise InvalidInput("rates_mbps", f"{self.rates_mbps} must be some of 0.1..100")
        if not self.losses or not all(0 <= loss <= 20 for loss in self.losses):
            raise InvalidInput("losses", f"{self.losses} must be some of 0..20 %")
        if not 5 <= self.seconds <= 3600:
            raise InvalidInput("seconds", f"{self.seconds} is outside 5..3600")

    def run(self) -> None:
        """Send, compare, write the rows, print them."""
        from lab.tcp.run import run_tcp

        run_tcp(self)
