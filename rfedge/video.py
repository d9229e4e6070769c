"""MP4 files for people to look at."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from rfcore.errors import InvalidInput
from rfcore.image import Rgb


def write_mp4(path: Path, frames: Iterable[Rgb], rate_hz: float) -> int:
    """Write pictures of one size and return how many; an odd last row or column is cut off.

    CRF 16, so that what is seen is the pictures' quality. Raises ``InvalidInput`` for none.
    """
    count = 0
    with av.open(str(path), "w") as container:
        rate = Fraction(rate_hz).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options={"crf": "16", "preset": "fast"})
        stream.pix_fmt = "yuv420p"
        for rgb in frames:
            height, width = (side - side % 2 for side in rgb.shape[:2])
            if not count:
                stream.width, stream.height = width, height
            even = np.ascontiguousarray(rgb[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
            count += 1
        if count:
            container.mux(stream.encode(None))
    if not count:
        path.unlink()
        raise InvalidInput("video", f"{path}: there is no picture to write")
    return count
