"""PSNR and SSIM: laws, closed forms, and torchmetrics as the oracle."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torchmetrics.functional.image import (
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

from rfcore.errors import InvalidInput
from rfcore.metrics import mean_squared_error, psnr, ssim

U8 = NDArray[np.uint8]


def noise(shape: tuple[int, ...], seed: int) -> U8:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def street(shape: tuple[int, int, int], seed: int) -> U8:
    """Smooth gradients plus noise: luminance, contrast and structure all matter."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    base = 120 + 60 * np.sin(x / 9 + seed)[..., None] + 40 * np.cos(y / 7)[..., None]
    grain = np.random.default_rng(seed).normal(0, 12, shape)
    return np.clip(base + grain, 0, 255).astype(np.uint8)


def as_batch(picture: NDArray[np.generic]) -> torch.Tensor:
    return torch.tensor(picture.astype(np.float64)).permute(2, 0, 1)[None]


shapes = st.tuples(st.integers(1, 24), st.integers(1, 24), st.just(3))


@given(shapes, st.integers(0, 99))
def test_a_picture_is_infinitely_like_itself(shape: tuple[int, int, int], seed: int) -> None:
    picture = noise(shape, seed)
    assert psnr(picture, picture) == math.inf
    assert ssim(picture, picture) == pytest.approx(1.0, abs=1e-12)


@given(shapes, st.integers(0, 99))
def test_the_order_of_the_pictures_does_not_matter(shape: tuple[int, int, int], seed: int) -> None:
    a, b = noise(shape, seed), noise(shape, seed + 100)
    assert psnr(a, b) == psnr(b, a)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-12)
    assert -1.0 <= ssim(a, b) <= 1.0


@pytest.mark.parametrize(("a", "b"), [(0, 255), (10, 13), (128, 127)])
@pytest.mark.parametrize("size", [(1, 1), (7, 30), (40, 12, 3)])
def test_constant_pictures_have_a_closed_form(a: int, b: int, size: tuple[int, ...]) -> None:
    flat_a, flat_b = np.full(size, a, np.uint8), np.full(size, b, np.uint8)
    assert mean_squared_error(flat_a, flat_b) == (a - b) ** 2
    assert psnr(flat_a, flat_b) == pytest.approx(20 * math.log10(255 / abs(a - b)))
    c1 = (0.01 * 255) ** 2
    want = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(flat_a, flat_b) == pytest.approx(want, abs=1e-9)


def test_black_against_white_is_zero_decibels() -> None:
    assert psnr(np.zeros((3, 3), np.uint8), np.full((3, 3), 255, np.uint8)) == 0.0


def test_scaling_pictures_and_peak_together_changes_nothing() -> None:
    a, b = street((30, 40, 3), 1), street((30, 40, 3), 2)
    small_a, small_b = a / 255.0, b / 255.0
    assert psnr(small_a, small_b, peak=1.0) == pytest.approx(psnr(a, b))
    assert ssim(small_a, small_b, peak=1.0) == pytest.approx(ssim(a, b), abs=1e-12)


def test_more_noise_is_further_away() -> None:
    clean = street((48, 64, 3), 0).astype(np.float64)
    grain = np.random.default_rng(5).normal(size=clean.shape)
    noisy = [clean + sigma * grain for sigma in (1.0, 4.0, 16.0)]
    ratios = [psnr(clean, picture, peak=255) for picture in noisy]
    likeness = [ssim(clean, picture, peak=255) for picture in noisy]
    assert ratios == sorted(ratios, reverse=True)
    assert likeness == sorted(likeness, reverse=True)


@pytest.mark.parametrize("shape", [(11, 11, 3), (36, 64, 3), (45, 31, 3)])
@pytest.mark.parametrize("make", [noise, street])
def test_torchmetrics_agrees(
    shape: tuple[int, int, int], make: Callable[[tuple[int, int, int], int], U8]
) -> None:
    a, b = make(shape, 1), make(shape, 2)
    want_psnr = peak_signal_noise_ratio(as_batch(a), as_batch(b), data_range=255.0)
    want_ssim = structural_similarity_index_measure(
        as_batch(a), as_batch(b), gaussian_kernel=True, sigma=1.5, data_range=255.0
    )
    assert psnr(a, b) == pytest.approx(want_psnr.item(), abs=1e-6)
    assert ssim(a, b) == pytest.approx(want_ssim.item(), abs=1e-6)


def test_a_small_picture_is_continued_by_reflection() -> None:
    """[a, b] continues as ... b a b a b ...: both pixels see the same mixture, weights p and q."""
    taps = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    p = float(taps[1::2].sum() / taps.sum())  # even offsets 0, 2, 4 lie at odd places
    a, b = np.array([[1, 2]], np.uint8), np.array([[2, 1]], np.uint8)
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    m, n = p + 2 * (1 - p), 2 * p + (1 - p)
    spread = p * (1 - p)
    want = (2 * m * n + c1) / (m * m + n * n + c1) * (c2 - 2 * spread) / (c2 + 2 * spread)
    assert ssim(a, b) == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize("measure", [psnr, ssim])
@pytest.mark.parametrize(
    ("a", "b", "named"),
    [
        (np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8), r"\(4, 4\).*\(4, 5\)"),
        (np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.float32), "uint8.*float32"),
        (np.zeros((4, 4), np.int32), np.zeros((4, 4), np.int32), "int32"),
        (np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), r"\(4, 4, 4\)"),
        (np.zeros((0, 4), np.uint8), np.zeros((0, 4), np.uint8), "with a pixel"),
        (np.full((4, 4), np.nan), np.zeros((4, 4)), "first picture has NaN"),
        (np.zeros((4, 4)), np.full((4, 4), np.inf), "second picture has NaN"),
        (np.zeros((4, 4)), np.zeros((4, 4)), "peak: must be given for float64"),
    ],
)
def test_pictures_that_cannot_be_compared_are_refused(
    measure: Callable[..., float], a: NDArray[np.generic], b: NDArray[np.generic], named: str
) -> None:
    with pytest.raises(InvalidInput, match=named):
        measure(a, b)


@pytest.mark.parametrize("peak", [0.0, -1.0, math.nan, math.inf])
def test_a_peak_that_is_no_peak_is_refused(peak: float) -> None:
    with pytest.raises(InvalidInput, match="peak"):
        psnr(np.zeros((4, 4)), np.ones((4, 4)), peak)
