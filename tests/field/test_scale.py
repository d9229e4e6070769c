"""Rendering at half the size: what a flat or a sloping picture becomes, and that sizes hold."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import Quality, SplatField
from rfcore.field.quality import colour_at_scale, view_at_scale
from rfcore.views import View
from tests.field.some import make_gaussians

HALF = Quality(scale=0.5)


def camera(width_px: int, height_px: int) -> Camera:
    k = Intrinsics(width_px, height_px, 20.0, 20.0, width_px / 2, height_px / 2)
    return Camera(k, Pose((0, 0, -4), (1, 0, 0, 0)))


def slope(seen: Camera, _quality: Quality) -> View:
    """Colour = x + 10 y in the pixels of the full size, by the pinhole's own arithmetic."""
    k = seen.intrinsics
    x = (np.arange(k.width_px) + 0.5 - k.cx_px) / k.fx_px
    y = (np.arange(k.height_px) + 0.5 - k.cy_px) / k.fy_px
    plane = (20 * x[None, :] + 200 * y[:, None]).astype(np.float32)
    return View(np.stack([plane] * 3, 2), np.abs(plane) + 1, plane * 0 + 1)


@pytest.mark.parametrize("size_px", [(16, 12), (15, 11), (2, 2)])
def test_a_slope_is_enlarged_to_itself_away_from_the_edge(size_px):
    full = slope(camera(*size_px), Quality())
    enlarged = view_at_scale(slope, camera(*size_px), HALF)
    inner = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(enlarged.colour[inner], full.colour[inner], atol=1e-4)
    np.testing.assert_array_equal(enlarged.opacity, full.opacity)


def test_depth_is_that_of_one_surface_never_a_mean():
    small = slope(camera(16, 12), Quality())
    enlarged = view_at_scale(slope, camera(16, 12), HALF)
    assert enlarged.depth.shape == small.depth.shape
    assert len(np.unique(enlarged.depth)) <= enlarged.depth.size // 4


@pytest.mark.parametrize("size_px", [(1, 1), (2, 3), (31, 20), (30, 21)])
def test_colour_alone_is_the_colour_of_the_view_at_any_size(size_px):
    field, seen = SplatField(make_gaussians(30, 1)), camera(*size_px)
    view = field.render(seen, HALF)
    width, height = size_px
    assert view.colour.shape == (height, width, 3)
    assert view.depth.shape == view.opacity.shape == (height, width)
    np.testing.assert_array_equal(field.render_colour(seen, HALF), view.colour)
    assert view.colour.flags.c_contiguous
    assert view.depth.flags.c_contiguous


def test_at_full_scale_nothing_is_touched():
    view = slope(camera(4, 4), Quality())
    assert view_at_scale(lambda *_: view, camera(4, 4), Quality()) is view
    assert colour_at_scale(lambda *_: view.colour, camera(4, 4), Quality()) is view.colour


def test_other_scales_are_refused():
    with pytest.raises(InvalidInput, match=r"quality\.scale: 0\.25 is neither 1 nor 0\.5"):
        Quality(scale=0.25)
