"""The missing parts of a render, where they are known by construction."""

import numpy as np
import pytest

from lab.paper.render_quality import (
    BANDS,
    colour_ssim,
    flip,
    render_quality,
    residual_bands,
)

RNG = np.random.default_rng(6)
NOISE = RNG.integers(40, 200, (64, 96, 3)).astype(np.uint8)


def wave(cycles_a_pixel):
    luma = 128 + 60 * np.sin(2 * np.pi * cycles_a_pixel * np.arange(96))
    return np.rint(np.broadcast_to(luma[None, :, None], (64, 96, 3))).astype(np.uint8)


FLAT = np.full((64, 96, 3), 128, np.uint8)


def test_the_camera_itself_misses_nothing():
    same = render_quality(NOISE, NOISE)
    assert (same.psnr_db, same.bands) == (np.inf, (0.0,) * len(BANDS))
    assert flip(NOISE, NOISE) == 0
    assert 0 < flip(FLAT, NOISE) < 1
    assert same.ssim == pytest.approx(1)


@pytest.mark.parametrize("band", range(len(BANDS)))
def test_a_render_without_a_frequency_misses_its_band(band):
    low, high = BANDS[band]
    texture = wave((low + min(high, 0.5)) / 2)
    both = (NOISE // 8 + texture // 2).astype(np.uint8)
    missing = (NOISE // 8 + FLAT // 2).astype(np.uint8)
    ratios = residual_bands(missing, both)
    assert np.argmax(ratios) == band
    assert ratios[band] > 0.5


def test_a_flat_render_might_as_well_not_be_there():
    # 1e-3: the means of the two differ, and the window spreads that a little.
    np.testing.assert_allclose(residual_bands(FLAT, NOISE)[1:], 1, rtol=1e-3)


def test_the_ssim_of_colour_is_the_mean_of_its_channels():
    other = NOISE.copy()
    other[..., 0] = 128
    grey = np.repeat(NOISE[..., :1], 3, axis=2)
    flat = np.full_like(grey, 128)
    assert colour_ssim(other, NOISE) == pytest.approx((2 + colour_ssim(flat, grey)) / 3)
