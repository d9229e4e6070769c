"""Smaller pictures are means over areas, and points land where the smaller camera says."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.dataset.assemble import area_averaged, check_reduction, middle_of_shape
from rfcore.errors import InvalidInput


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_a_whole_factor_is_the_mean_of_blocks():
    rgb = noise(12, 18)
    blocks = rgb.reshape(4, 3, 6, 3, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(area_averaged(rgb, 6, 4), np.floor(blocks + 0.5))


def test_a_broken_factor_weighs_by_area():
    """Three pixels to two: the middle one counts half for either."""
    row = np.array([[[30] * 3, [60] * 3, [120] * 3]], np.uint8)
    np.testing.assert_array_equal(area_averaged(row, 2, 1)[0, :, 0], [40, 100])


@pytest.mark.parametrize("level", [0, 1, 254, 255])
def test_a_constant_picture_stays_constant(level):
    assert (area_averaged(np.full((17, 31, 3), level, np.uint8), 7, 5) == level).all()


def test_the_same_size_changes_nothing():
    rgb = noise(9, 14)
    np.testing.assert_array_equal(area_averaged(rgb, 14, 9), rgb)


def test_a_point_lands_on_the_same_place_of_the_smaller_picture():
    """Pixel centres at +0.5: the place u of w is the place u s of w s, with nothing added."""
    k = Intrinsics(640, 360, 400.0, 410.0, 322.0, 178.0)
    large, small = (Camera(i, Pose.identity()) for i in (k, k.resized(160, 120)))
    u, v, _ = large.project((0.3, -0.2, 2.0))
    assert small.project((0.3, -0.2, 2.0))[:2] == pytest.approx((u / 4, v / 3))


@pytest.mark.parametrize("size_px", [(0, 4), (11, 4), (4, 9)])
def test_only_a_reduction_is_taken(size_px):
    check_reduction("a.png", (10, 8), (10, 8))
    with pytest.raises(InvalidInput, match=r"a\.png"):
        check_reduction("a.png", (10, 8), size_px)


@pytest.mark.parametrize(
    ("from_px", "to_px", "part"),
    [
        ((1080, 1920), (360, 640), (0, 0, 1080, 1920)),
        ((640, 480), (320, 180), (0, 60, 640, 360)),
        ((1242, 375), (400, 200), (246, 0, 750, 375)),
        ((5, 3), (4, 2), (0, 0, 5, 3)),
    ],
)
def test_another_shape_takes_the_largest_middle_part(from_px, to_px, part):
    """Sides are whole pixels: the shape is met to half a pixel."""
    left, top, width, height = middle_of_shape("a.png", from_px, to_px)
    if part != (0, 0, 5, 3):
        assert (left, top, width, height) == part
    assert abs(width - height * to_px[0] / to_px[1]) <= max(0.5, 0.5 * to_px[0] / to_px[1])


def test_a_shape_that_leaves_less_than_half_is_refused_with_one_that_fits():
    with pytest.raises(InvalidInput, match=r"640x360.*a\.png, 1080x1920 px.*32%; 360x640 has"):
        middle_of_shape("a.png", (1080, 1920), (640, 360))
