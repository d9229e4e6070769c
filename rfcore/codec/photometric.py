"""The photometric side channel: a render under another light, computed alike by both ends.

When the scene is lit otherwise than the field was, the sender finds the matrix M [3, 4] that maps
the render's (Y, U, V, 1) closest to the frame's (Y, U, V), and sends it in 12 numbers. Both ends
apply it to the render before it becomes a reference. Any change of light that scales and mixes RGB
channels linearly and adds to them is such a matrix, as YUV is linear in RGB.

In integers, so that both ends get the same bytes: coefficients are in 1/4096 (columns Y, U, V), the
last column in levels / 16. Chroma rows see the rounded mean of the 2x2 luma samples; luma rows see
the chroma sample of their block; a last odd row or column counts twice. Y, U and V enter without
their offsets (16, 128, 128), sums are rounded half up, and samples clamped to 1..255.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420

__all__ = ["COEFFICIENTS", "Photometric", "adapt", "check_photometric", "solve"]

COEFFICIENTS = 12
LIMIT = 1 << 15
_FRACTION_BITS = 12
_LEVEL_BITS = 4
_BLACK = (16, 128, 128)
_ROUNDS = 3
_SAMPLES_PER_SIDE = 90

Photometric = tuple[int, ...]
"""Nothing, or M row by row."""

I32 = NDArray[np.int32]
F64 = NDArray[np.floating[Any]]


def check_photometric(photometric: Photometric) -> Photometric:
    """Return ``photometric``; raise ``InvalidInput`` unless it is empty or 12 16-bit numbers."""
    if len(photometric) not in (0, COEFFICIENTS):
        raise InvalidInput("photometric", f"{len(photometric)} numbers where 0 or 12 are expected")
    for number in photometric:
        if not -LIMIT <= number < LIMIT:
            raise InvalidInput("photometric", f"{number} is outside {-LIMIT}..{LIMIT - 1}")
    return photometric


def adapt(render: I420, photometric: Photometric) -> I420:
    """Return ``render`` under the light of ``photometric``; itself if that is nothing."""
    if not photometric:
        return render
    m = np.array(photometric, np.int32).reshape(3, 4)
    m[:, 3] <<= _FRACTION_BITS - _LEVEL_BITS
    luma, u, v = (
        p.astype(np.int32) - black for p, black in zip(render.planes, _BLACK, strict=True)
    )
    height, width = luma.shape
    chroma_for_luma = m[0, 1] * u + m[0, 2] * v + m[0, 3]
    y_out = m[0, 0] * luma + chroma_for_luma.repeat(2, 0).repeat(2, 1)[:height, :width]
    mean = _luma_at_chroma(luma)
    u_out, v_out = (m[row, 0] * mean + m[row, 1] * u + m[row, 2] * v + m[row, 3] for row in (1, 2))
    return I420(*(_levels(p, b) for p, b in zip((y_out, u_out, v_out), _BLACK, strict=True)))


def solve(frame: I420, render: I420) -> Photometric:
    """Return the matrix that maps ``render`` closest to ``frame``.

    Least squares over about 90x90 blocks of 2x2 px, three times, each time with blocks further than
    twice the median off left out: those show what is not in the field.
    """
    source, target = _samples(render), _samples(frame)
    keep = np.ones(len(source), bool)
    solution: F64 = np.zeros((4, 3))
    for _ in range(_ROUNDS):
        solution, *_ = np.linalg.lstsq(source[keep], target[keep, :3], rcond=None)
        error = np.abs(source @ solution - target[:, :3]).sum(axis=1)
        keep = error <= 2 * np.median(error) + 1e-9
    scale = np.array([1 << _FRACTION_BITS] * 3 + [1 << _LEVEL_BITS])
    numbers = np.rint(solution.T * scale).clip(-LIMIT, LIMIT - 1).astype(int)
    return tuple(numbers.ravel().tolist())


def _samples(picture: I420) -> F64:
    """Return [N, 4]: Y, U, V without offsets, and 1, of evenly spread 2x2 blocks."""
    luma = _luma_at_chroma(picture.y.astype(np.int32) - _BLACK[0])
    planes = (luma, picture.u.astype(np.int32) - 128, picture.v.astype(np.int32) - 128)
    step = max(1, min(luma.shape) // _SAMPLES_PER_SIDE)
    columns = [plane[::step, ::step].ravel() for plane in planes]
    return np.stack([*columns, np.ones_like(columns[0])], axis=1).astype(np.float64)


def _luma_at_chroma(luma: I32) -> I32:
    """Return the means of 2x2 luma blocks, one for each chroma sample, rounded half up."""
    height, width = luma.shape
    if height % 2 or width % 2:
        luma = np.pad(luma, ((0, height % 2), (0, width % 2)), mode="edge")
    sums = luma[0::2, 0::2] + luma[0::2, 1::2] + luma[1::2, 0::2] + luma[1::2, 1::2]
    return (sums + 2) >> 2


def _levels(sums: I32, black: int) -> NDArray[np.uint8]:
    rounded = (sums + (1 << (_FRACTION_BITS - 1))) >> _FRACTION_BITS
    levels: NDArray[np.uint8] = np.clip(rounded + black, 1, 255).astype(np.uint8)
    return levels
