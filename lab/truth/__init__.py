"""``rfedge-lab live-truth``: what cameras and receivers as they are make of pictures and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["EvalLiveTruth"]


@dataclass(frozen=True)
class EvalLiveTruth:
    """Count wrong pictures, delays and wrong poses where packets are lost and sensors say less.

    Streams whose every picture is known go by RTP over the loopback device to the agent's live
    source, sentences to its pose feed, some through the real gpsd and GStreamer's RTSP server.
    """

    comma: Path | None = None
    """A segment of comma2k19: u-blox fixes beside reference poses."""
    before: str | None = None
    """A revision to measure too, by the same cases."""
    cases: tuple[str, ...] = ()
    """Only cases whose names contain one of these."""
    out: Path = Path("out/eval/live-truth.json")

    def run(self) -> None:
        """Measure, write the rows, print them."""
        from lab.truth.run import run_live_truth

        run_live_truth(self)
