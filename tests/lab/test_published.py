"""The published experiment's rows: what must hold of them whatever the pictures."""

import numpy as np
import pytest

from lab.paper.run import (
    PublishedFrame,
    Setting,
    published_rows,
    reduced,
)
from rfcore.errors import InvalidInput
from rfcore.native.yuv import i420_from_rgb
from rfedge.evaluate.savings import paper_savings

SMALL = Setting((64, 48), "downscaled", "medium", 23.0)


def picture(seed, side=16):
    """Blocks of noise, uint8 [96, 128, 3]."""
    blocks = np.random.default_rng(seed).integers(30, 220, (96 // side, 128 // side, 3))
    return blocks.repeat(side, 0).repeat(side, 1).astype(np.uint8)


def frame(render, camera=None):
    camera = picture(1) if camera is None else camera
    return PublishedFrame("f0", camera, lambda size_px, _making: reduced(render, size_px))


def row(render, setting=SMALL):
    (made,) = published_rows(frame(render), [setting])
    return made


def test_a_render_that_is_the_camera_costs_less_than_one_that_is_not():
    assert row(picture(1))["p_bytes"] < row(picture(2))["p_bytes"]


def test_the_savings_are_the_published_formula_of_the_bytes():
    made = row(picture(2))
    expected = 100 * made["i_bytes"] / (made["i_bytes"] + made["p_bytes"])
    assert made["savings_percent"] == pytest.approx(expected)
    camera, render = (i420_from_rgb(reduced(picture(k), SMALL.size_px)) for k in (1, 2))
    assert made["savings_percent"] == paper_savings(camera, render, "medium", 23.0).percent


def test_a_finer_rate_factor_costs_more_and_shows_it():
    fine, coarse = (row(picture(2), Setting((64, 48), "downscaled", "medium", c)) for c in (18, 28))
    assert fine["camera_i_bytes"] > coarse["camera_i_bytes"]
    assert fine["camera_i_psnr_db"] > coarse["camera_i_psnr_db"]
    assert fine["psnr_db"] > coarse["psnr_db"]


def test_reducing_keeps_the_mean_of_each_area():
    noise = np.random.default_rng(7).integers(0, 256, (96, 128, 3)).astype(np.uint8)
    areas = noise.astype(float).reshape(48, 2, 64, 2, 3).mean((1, 3))
    assert np.abs(reduced(noise, (64, 48)) - areas).max() <= 0.5


def test_a_size_larger_than_the_frame_is_refused():
    with pytest.raises(InvalidInput, match="larger than the frame"):
        reduced(picture(1), (130, 96))
