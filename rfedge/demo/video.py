"""Write the reconstructed drives, camera beside twin, as one MP4 file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from rfedge.demo.measure import Pictures

__all__ = ["write_video"]


def write_video(path: Path, drives: Mapping[str, Sequence[Pictures]], rate_hz: float) -> None:
    """Write every drive in turn: the camera on the left, the server's reconstruction on the right.

    All pictures must have one size. CRF 16, so that what is seen is the reconstruction's quality.
    """
    frames = [frame for drive in drives.values() for frame in drive]
    height, width, _ = frames[0].camera.shape
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264",
            rate=Fraction(rate_hz).limit_denominator(1000),
            options={"crf": "16", "preset": "fast"},
        )
        stream.width, stream.height, stream.pix_fmt = (
            2 * width - 2 * width % 2,
            height - height % 2,
            "yuv420p",
        )
        for frame in frames:
            pair = np.hstack([frame.camera, frame.reconstruction])[: stream.height, : stream.width]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(pair), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
