"""Photometric side information: both ends map a render to another light in the same way.

When the scene is lit differently from the field, the sender says how the render's samples change.
Both ends apply that to the render before it becomes a reference. There are two ways:

* A *matrix* M [3, 4] that maps the render's (Y, U, V, 1) closest to the frame's (Y, U, V), in 12
  numbers: any change of light that scales and mixes RGB channels linearly and adds to them, as YUV
  is linear in RGB.
* A *light*, for a frame without an earlier one to learn it from (``rfcore.native.warp``): a
  bilateral grid by place and luma, in at most ``MOST_LIGHT_BYTES``.

The matrix is applied in integers, so that both ends get the same bytes: coefficients are in 1/4096
(columns Y, U, V), the last column in levels / 16. Chroma rows see the rounded mean of the 2x2 luma
samples; luma rows see the chroma sample of their block; a last odd row or column counts twice. Y, U
and V enter without their offsets (16, 128, 128), sums are rounded half up, and samples are clamped
to 1..255.

A light is written as a byte, the step S in levels, and a raw deflate stream (RFC 1951) of one byte
for each plane, bin, row and column of the grid, in this order: by how many steps samples change
there, int8, minus the median of three values (the left neighbour, the upper one, and their sum
minus the upper left one), modulo 256. Beyond the first row or column the nearest value is repeated;
the corner's is 0.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import apply_light, light_shape, solve_light

COEFFICIENTS = 12
LIMIT = 1 << 15
_FRACTION_BITS = 12
_LEVEL_BITS = 4
_BLACK = (16, 128, 128)
_ROUNDS = 3
_SAMPLES = 160 * 90

MOST_LIGHT_BYTES = 1024
LIGHT_STEPS = (4, 8, 16, 32)
"""Step sizes in levels. With a field of noon, the light of the benchmark street's first frame at
dusk takes 509 bytes in steps of 4 levels, with which the frame takes the fewest bits; in steps of 1
level it takes 791 bytes, in steps of 8 levels 385."""
_LEVEL = 1 << 8
"""One level in the unit of ``rfcore.native.warp``."""
_RAW_DEFLATE = -zlib.MAX_WBITS

Photometric = tuple[int, ...]
"""The matrix M row by row; empty for no change of light."""

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
    """Return ``render`` under the light of ``photometric``; ``render`` itself if that is empty."""
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

    Least squares over evenly spread blocks of 2x2 px, about 14,400 at most, three times, each time
    with blocks further than twice the median off left out: those show what is not in the field.
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


def sent_light(frame: I420, render: I420) -> bytes:
    """Return the light that maps ``render`` to ``frame``, as it is sent; empty if it would be
    longer than ``MOST_LIGHT_BYTES``."""
    changes = solve_light(frame, render)
    for step in LIGHT_STEPS:
        unit = step * _LEVEL
        steps = ((changes + unit // 2) // unit).clip(-128, 127)
        deflate = zlib.compressobj(9, zlib.DEFLATED, _RAW_DEFLATE, 9, zlib.Z_FILTERED)
        data = _residuals(steps.transpose(3, 2, 0, 1)).astype(np.uint8).tobytes()
        light = bytes((step,)) + deflate.compress(data) + deflate.flush()
        if len(light) <= MOST_LIGHT_BYTES:
            return light
    return b""


def lit_by(render: I420, light: bytes) -> I420:
    """Return ``render`` under a light that was sent.

    Raises ``InvalidInput`` for bytes that are no light of a picture of that size.
    """
    rows, columns, bins, planes = shape = light_shape(render.size_px)
    if not 1 < len(light) <= MOST_LIGHT_BYTES:
        raise InvalidInput("light", f"{len(light)} bytes where 2..{MOST_LIGHT_BYTES} are expected")
    if light[0] not in LIGHT_STEPS:
        raise InvalidInput("light", f"a step of {light[0]} levels is none of {LIGHT_STEPS}")
    count, inflate = planes * bins * rows * columns, zlib.decompressobj(_RAW_DEFLATE)
    try:
        data = inflate.decompress(light[1:], count + 1)
    except zlib.error as error:
        raise InvalidInput("light", f"is not deflated: {error}") from error
    if len(data) != count or not inflate.eof or inflate.unused_data:
        raise InvalidInput("light", f"does not hold {count} numbers, of a grid of shape {shape}")
    residuals = np.frombuffer(data, np.uint8).reshape(planes, bins, rows, columns)
    steps = _summed(residuals).astype(np.int8).astype(np.int32)
    return apply_light(render, steps.transpose(2, 3, 1, 0) * (light[0] * _LEVEL))


def _residuals(steps: I32) -> I32:
    """Return steps [..., rows, columns] minus their prediction from earlier ones, modulo 256."""
    expected = np.zeros_like(steps)
    left, above, corner = steps[..., 1:, :-1], steps[..., :-1, 1:], steps[..., :-1, :-1]
    expected[..., 1:, 1:] = _median(left, above, left + above - corner)
    expected[..., 0, 1:] = steps[..., 0, :-1]
    expected[..., 1:, 0] = steps[..., :-1, 0]
    return np.asarray((steps - expected) & 0xFF, np.int32)


def _summed(residuals: NDArray[np.uint8]) -> I32:
    """Return the steps, int8 values as int32, of residuals [planes, bins, rows, columns]."""
    steps = np.zeros(residuals.shape, np.int32)
    _, _, rows, columns = residuals.shape
    for row in range(rows):
        for column in range(columns):
            expected = _expected(steps, row, column)
            steps[..., row, column] = ((residuals[..., row, column] + expected + 128) & 0xFF) - 128
    return steps


def _expected(steps: I32, row: int, column: int) -> I32:
    if not row and not column:
        return np.zeros_like(steps[..., 0, 0])
    left, above = steps[..., row, column - 1], steps[..., row - 1, column]
    if not row or not column:
        return above if row else left
    return _median(left, above, left + above - steps[..., row - 1, column - 1])


def _median(a: I32, b: I32, c: I32) -> I32:
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


def _samples(picture: I420) -> F64:
    """Return [N, 4]: Y, U, V without offsets, and 1, of evenly spread 2x2 blocks."""
    luma = _luma_at_chroma(picture.y.astype(np.int32) - _BLACK[0])
    planes = (luma, picture.u.astype(np.int32) - 128, picture.v.astype(np.int32) - 128)
    step = math.ceil(math.sqrt(luma.size / _SAMPLES))
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
