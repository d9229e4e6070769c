"""The samples of an I_PCM picture, macroblock by macroblock (ITU-T H.264, 7.3.5).

What they are for, and the definition, is in ``rfcore.codec.h264.pcm_picture``: 256 Y, 64 Cb and 64
Cr a macroblock, the two bytes 0x0D 0x00 before each but the first, samples raised to at least 1,
and the last row and column repeated up to whole macroblocks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native

__all__ = ["pcm_bytes", "write_macroblocks"]

_MB_PX = 16
_MB_BYTES = 2 + 256 + 64 + 64


def pcm_bytes(size_px: tuple[int, int]) -> int:
    """Return how many bytes ``write_macroblocks`` writes for a picture of (width, height)."""
    width_px, height_px = size_px
    return -(-width_px // _MB_PX) * -(-height_px // _MB_PX) * _MB_BYTES - 2


def write_macroblocks(picture: I420, out: NDArray[np.uint8]) -> None:
    """Write the macroblocks of ``picture`` to ``out``, uint8 [pcm_bytes], which is contiguous.

    Raises ``InvalidInput`` for another shape or an empty picture.
    """
    expected = pcm_bytes(picture.size_px)
    if out.shape != (expected,) or expected < _MB_BYTES - 2:
        raise InvalidInput(
            "out", f"shape {out.shape} for a picture of {picture.size_px} px, not ({expected},)"
        )
    y, u, v = (np.ascontiguousarray(plane) for plane in picture.planes)
    _native.pcm_macroblocks(y, u, v, out)
