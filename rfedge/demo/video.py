"""Write the reconstructed drives, camera beside twin, as one MP4 file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rfedge.demo.measure import Pictures
from rfedge.video import write_mp4

__all__ = ["write_video"]


def write_video(path: Path, drives: Mapping[str, Sequence[Pictures]], rate_hz: float) -> None:
    """Write every drive in turn: the camera on the left, the server's reconstruction on the right.

    All pictures must have one size.
    """
    frames = (frame for drive in drives.values() for frame in drive)
    write_mp4(path, (np.hstack([f.camera, f.reconstruction]) for f in frames), rate_hz)
