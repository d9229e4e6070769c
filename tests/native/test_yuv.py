"""RGB <-> I420: golden colours of BT.709, an exact integer oracle, and bounds of the way back."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.yuv import i420_from_colour, i420_from_rgb, rgb_from_i420

SIZES = [(1, 1), (1, 7), (2, 2), (3, 5), (33, 31), (64, 48), (301, 169)]
KR, KB = Fraction(2126, 10000), Fraction(722, 10000)
KG = 1 - KR - KB


def noise(width_px: int, height_px: int, seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (height_px, width_px, 3), dtype=np.uint8)


def flat(rgb: tuple[int, int, int]) -> NDArray[np.uint8]:
    return np.full((2, 2, 3), rgb, np.uint8)


def oracle_i420(rgb: NDArray[np.uint8]) -> I420:
    """The docstring's integer formulas in int64, with the edge replicated by np.pad."""
    height, width = rgb.shape[:2]
    c = rgb.astype(np.int64)
    y = (c @ [11966, 40254, 4064] + (16 << 16) + (1 << 15)) >> 16
    even = np.pad(c, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    sums = even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]
    offset = (128 << 18) + (1 << 17)
    u = (sums @ [-6596, -22188, 28784] + offset) >> 18
    v = (sums @ [28784, -26145, -2639] + offset) >> 18
    return I420(y.astype(np.uint8), u.astype(np.uint8), v.astype(np.uint8))


def oracle_rgb(picture: I420) -> NDArray[np.uint8]:
    height, width = picture.y.shape
    luma = 76309 * (picture.y.astype(np.int64) - 16) + (1 << 15)
    cb, cr = (
        p.repeat(2, 0).repeat(2, 1)[:height, :width].astype(np.int64) - 128
        for p in (picture.u, picture.v)
    )
    channels = (luma + 117489 * cr, luma - 13975 * cb - 34925 * cr, luma + 138438 * cb)
    return np.clip(np.stack(channels, -1) >> 16, 0, 255).astype(np.uint8)


def same(a: I420, b: I420) -> bool:
    return all(np.array_equal(p, q) for p, q in zip(a.planes, b.planes, strict=True))


@pytest.mark.parametrize(("width_px", "height_px"), SIZES)
def test_the_kernel_equals_the_integer_definition(width_px, height_px):
    rgb = noise(width_px, height_px)
    picture = i420_from_rgb(rgb)
    assert same(picture, oracle_i420(rgb))
    assert np.array_equal(rgb_from_i420(picture), oracle_rgb(picture))


@pytest.mark.parametrize(("width_px", "height_px"), SIZES)
def test_any_three_planes_convert_back_as_defined(width_px, height_px):
    rng = np.random.default_rng(3)
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    shapes = ((height_px, width_px), half, half)
    picture = I420(*(rng.integers(0, 256, s, dtype=np.uint8) for s in shapes))
    assert np.array_equal(rgb_from_i420(picture), oracle_rgb(picture))


@pytest.mark.parametrize(
    ("rgb", "yuv"),
    [
        ((255, 255, 255), (235, 128, 128)),
        ((0, 0, 0), (16, 128, 128)),
        ((255, 0, 0), (63, 102, 240)),
        ((0, 255, 0), (173, 42, 26)),
        ((0, 0, 255), (32, 240, 118)),
        ((255, 255, 0), (219, 16, 138)),
        ((0, 255, 255), (188, 154, 16)),
        ((255, 0, 255), (78, 214, 230)),
    ],
)
def test_full_colour_bars_have_the_values_of_the_standard(rgb, yuv):
    picture = i420_from_rgb(flat(rgb))
    assert tuple(int(p[0, 0]) for p in picture.planes) == yuv


def test_greys_have_no_chroma_and_an_exactly_rounded_luma():
    ramp = np.arange(256, dtype=np.uint8)
    picture = i420_from_rgb(np.stack([ramp] * 3, -1)[:, None])
    exact = [16 + int(Fraction(219 * g, 255) + Fraction(1, 2)) for g in range(256)]
    assert picture.y[:, 0].tolist() == exact
    assert (picture.u == 128).all()
    assert (picture.v == 128).all()


def test_samples_are_the_rounded_real_valued_ones_to_a_hundredth_of_a_level():
    rgb = np.repeat(np.repeat(noise(64, 64, seed=5), 2, 0), 2, 1)
    picture = i420_from_rgb(rgb)
    r, g, b = np.moveaxis(rgb[::2, ::2].astype(float), -1, 0)
    y = float(KR) * r + float(KG) * g + float(KB) * b
    exact = (
        16 + 219 / 255 * y,
        128 + 224 / 255 * (b - y) / float(2 * (1 - KB)),
        128 + 224 / 255 * (r - y) / float(2 * (1 - KR)),
    )
    got = (picture.y[::2, ::2], picture.u, picture.v)
    for plane, want in zip(got, exact, strict=True):
        assert np.abs(plane - want).max() <= 0.5 + 0.008


def test_samples_stay_in_the_limited_range_and_never_reach_zero():
    corners = np.array(np.meshgrid([0, 255], [0, 255], [0, 255])).reshape(3, -1).T
    for colour in corners.astype(np.uint8):
        picture = i420_from_rgb(np.broadcast_to(colour, (2, 2, 3)))
        assert 16 <= int(picture.y.min()) <= int(picture.y.max()) <= 235
        assert all(16 <= int(p.min()) <= int(p.max()) <= 240 for p in picture.planes[1:])


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_a_flat_colour_comes_back_within_one_level_and_blue_within_two(rgb):
    """Y, U, V are each off by half a level at most, so R is off by at most
    0.5 * 1.164 + 0.5 * 1.793 = 1.48 before it is rounded, G by 0.96 and B by 1.64."""
    back = rgb_from_i420(i420_from_rgb(flat(rgb)))[0, 0].astype(int)
    assert (np.abs(back - np.array(rgb)) <= (1, 1, 2)).all()


@pytest.mark.parametrize(("width_px", "height_px"), SIZES)
def test_colour_is_clamped_and_rounded_half_up_then_converted_as_rgb(width_px, height_px):
    rng = np.random.default_rng(2)
    colour = rng.uniform(-0.5, 1.5, (height_px, width_px, 3)).astype(np.float32)
    scaled = np.clip(colour, 0, 1) * np.float32(255) + np.float32(0.5)
    assert same(i420_from_colour(colour), oracle_i420(np.floor(scaled).astype(np.uint8)))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 3, 4])
def test_colours_that_are_not_finite_are_refused_and_counted(bad, row):
    colour = np.zeros((5, 7, 3), np.float32)
    colour[row, 2:4, 1] = bad
    with pytest.raises(InvalidInput, match="colour: 2 of 105 values are NaN or infinite"):
        i420_from_colour(colour)


def test_a_view_with_strides_converts_like_its_copy():
    rgb = noise(40, 30)
    assert same(i420_from_rgb(rgb[::2, ::-1]), i420_from_rgb(rgb[::2, ::-1].copy()))


@pytest.mark.parametrize(
    ("picture", "problem"),
    [
        (np.zeros((4, 4), np.uint8), r"shape \(4, 4\) must be \[H, W, 3\]"),
        (np.zeros((0, 4, 3), np.uint8), r"shape \(0, 4, 3\)"),
        (np.zeros((4, 4, 3), np.uint16), "dtype uint16 must be uint8"),
    ],
)
def test_other_shapes_and_types_are_refused(picture, problem):
    with pytest.raises(InvalidInput, match=problem):
        i420_from_rgb(picture)
