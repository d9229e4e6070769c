"""Hard pictures: flat, black, white, of one pixel, of odd sides, identical, nearly identical."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hard.cases.case import Case, Finding, refusal, statement, within
from rfcore.errors import InvalidInput
from rfcore.metrics import psnr, ssim
from rfcore.native.yuv import i420_from_colour, i420_from_rgb, rgb_from_i420

GROUP = "Pictures and metrics"
C1 = (0.01 * 255) ** 2
Shape = tuple[int, ...]
U8 = NDArray[np.uint8]

SIZES: tuple[Shape, ...] = ((1, 1, 3), (1, 7, 3), (5, 3, 3), (16, 16, 3), (37, 61, 3))


def _flat(shape: Shape, level: int) -> U8:
    return np.full(shape, level, np.uint8)


def _noise(shape: Shape, seed: int = 0) -> U8:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _identical(shape: Shape) -> Finding:
    picture = _noise(shape)
    likeness = ssim(picture, picture)
    infinite = psnr(picture, picture) == math.inf
    return Finding(
        f"inf dB, SSIM {likeness!r}", infinite and likeness == 1.0, abs(1.0 - likeness), 0.0
    )


def _flat_pair(a: int, b: int, shape: Shape) -> Finding:
    """For constants only the luminance term of SSIM is left."""
    ratio_db, likeness = (
        psnr(_flat(shape, a), _flat(shape, b)),
        ssim(_flat(shape, a), _flat(shape, b)),
    )
    want_db = 20 * math.log10(255 / abs(a - b))
    want = (2 * a * b + C1) / (a * a + b * b + C1)
    error = max(abs(ratio_db - want_db), abs(likeness - want))
    return within(error, 1e-12, f"{ratio_db:.4f} dB, SSIM {likeness:.6f}")


def _one_level_in_a_million() -> Finding:
    a = _flat((1000, 1000), 128)
    b = a.copy()
    b[500, 500] = 129
    want_db = 10 * math.log10(255**2 * 1e6)
    return within(abs(psnr(a, b) - want_db), 1e-9, f"{psnr(a, b):.6f} dB")


def _faint_contrast() -> Finding:
    """Contrast of 1e-6 on a level of 0.75: variances have lost ten digits, SSIM none."""
    grain = np.random.default_rng(3).normal(size=(40, 50))
    a, b = 0.75 + 1e-6 * grain, 0.75 - 1e-6 * grain
    want = 1.0  # C2 = 9e-4 against variances of 1e-12
    return within(abs(ssim(a, b, peak=1.0) - want), 1e-8, f"SSIM {ssim(a, b, peak=1.0):.12f}")


def _opposite() -> Finding:
    """x and -x about a mean: covariance is -variance; the definition, term by term, in float64."""
    shape = (32, 32)
    checks = np.indices(shape).sum(axis=0) % 2
    a, b = (255 * checks).astype(np.uint8), (255 * (1 - checks)).astype(np.uint8)
    likeness = ssim(a, b)
    return statement(-1.0 <= likeness < -0.99, f"SSIM {likeness:.6f}", f"SSIM {likeness}")


def _metric_of_nan() -> Finding:
    bad = np.full((4, 4), np.nan)
    return refusal(lambda: psnr(bad, np.zeros((4, 4)), peak=1.0), InvalidInput, "NaN")


def _yuv_level(rgb: tuple[int, int, int], want: tuple[int, int, int]) -> Finding:
    picture = i420_from_rgb(np.full((5, 3, 3), rgb, np.uint8))
    got = tuple(int(np.unique(plane).item()) for plane in picture.planes)
    return statement(got == want, f"Y, U, V = {got}", f"Y, U, V = {got}")


def _grey_round_trip() -> Finding:
    """Limited range has 219 steps for 255 levels: grey comes back to within one."""
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    back = rgb_from_i420(i420_from_rgb(np.ascontiguousarray(ramp)))
    return within(float(np.abs(back.astype(int) - ramp).max()), 1.0, "levels")


def _colour_equals_rgb(shape: Shape) -> Finding:
    """Floats of 8-bit levels convert as the levels do, whatever the size."""
    rgb = _noise(shape, 5)
    a, b = i420_from_colour(rgb.astype(np.float32) / np.float32(255)), i420_from_rgb(rgb)
    return statement(a.digest() == b.digest(), "equal bytes", "bytes differ")


def _out_of_range() -> Finding:
    colour = np.random.default_rng(1).normal(0.5, 1e18, (6, 8, 3)).astype(np.float32)
    clipped = np.clip(colour, 0, 1)
    same = i420_from_colour(colour).digest() == i420_from_colour(clipped).digest()
    return statement(same, "clamped to 0..1", "not clamped")


def _yuv_against_float64() -> Finding:
    """Integers against BT.709 in float64: 219/255 a level, half a step of rounding."""
    rgb = _noise((36, 64, 3), 9)
    luma = i420_from_rgb(rgb).y.astype(np.float64)
    want = 16 + 219 / 255 * (rgb @ np.array([0.2126, 0.7152, 0.0722]))
    return within(float(np.abs(luma - want).max()), 0.5 + 0.005, "levels")


def _not_finite(value: float) -> Finding:
    colour = np.zeros((4, 6, 3), np.float32)
    colour[2, 3, 1] = value
    return refusal(lambda: i420_from_colour(colour), InvalidInput, "finite")


def _case(name: str, expected: str, measure: Callable[[], Finding]) -> Case:
    return Case(GROUP, name, expected, measure)


def _size(shape: Shape) -> str:
    return f"{shape[1]} x {shape[0]}"


CASES = (
    *(
        _case(f"identical, {_size(s)}", "infinite PSNR, SSIM exactly 1", partial(_identical, s))
        for s in SIZES
    ),
    _case(
        "black against white",
        "0 dB, SSIM C1 / (255^2 + C1)",
        partial(_flat_pair, 0, 255, (9, 7, 3)),
    ),
    _case(
        "grey against its neighbour", "the closed form", partial(_flat_pair, 128, 127, (40, 12, 3))
    ),
    _case("flat, one pixel", "the closed form", partial(_flat_pair, 10, 13, (1, 1, 3))),
    _case("one level in a million", "10 log10(255^2 10^6)", _one_level_in_a_million),
    _case("contrast of 1e-6", "1: C2 outweighs it", _faint_contrast),
    _case("a check board against its negative", "nearly -1, never below", _opposite),
    _case("NaN in a picture", "refused", _metric_of_nan),
    _case("black as YUV", "16, 128, 128", partial(_yuv_level, (0, 0, 0), (16, 128, 128))),
    _case("white as YUV", "235, 128, 128", partial(_yuv_level, (255, 255, 255), (235, 128, 128))),
    _case("blue as YUV", "32, 240, 118", partial(_yuv_level, (0, 0, 255), (32, 240, 118))),
    _case("grey there and back", "within one level", _grey_round_trip),
    _case("luma of noise", "BT.709 in float64, to half a step", _yuv_against_float64),
    *(
        _case(
            f"float picture, {_size(s)}",
            "the bytes of its 8-bit levels",
            partial(_colour_equals_rgb, s),
        )
        for s in SIZES
    ),
    _case("colours of +-1e18", "clamped to 0..1", _out_of_range),
    _case("NaN colour to YUV", "refused", partial(_not_finite, math.nan)),
    _case("infinite colour to YUV", "refused", partial(_not_finite, math.inf)),
)
