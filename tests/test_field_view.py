"""A field's view at a camera is the same on both ends: one conversion, one rounding, one check."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FULL, Quality, SplatField, render_field_view
from rfcore.native.yuv import i420_from_colour
from rfcore.views import View, confidence
from tests.field.some import make_gaussians

SIZE_PX = (10, 6)
CAMERA = Camera(
    Intrinsics(*SIZE_PX, 8.0, 8.0, 5.0, 3.0), Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
)


class Wall:
    """A renderer of a wall 5 m ahead that lets a quarter of the light through; notes requests."""

    def __init__(self) -> None:
        self.asked: list[tuple[Camera, Quality]] = []
        rng = np.random.default_rng(3)
        self.view = View(
            rng.uniform(0, 1, (*SIZE_PX[::-1], 3)).astype(np.float32),
            np.full(SIZE_PX[::-1], 5, np.float32),
            np.full(SIZE_PX[::-1], 0.75, np.float32),
        )

    def render(self, camera: Camera, quality: Quality) -> View:
        self.asked.append((camera, quality))
        return self.view


def test_a_rendered_view_is_the_codecs_picture_with_the_renderers_depth_and_opacity():
    wall = Wall()
    view = render_field_view(wall, CAMERA)
    assert view.render.digest() == i420_from_colour(wall.view.colour).digest()
    assert view.camera is CAMERA
    assert view.depth is wall.view.depth
    assert view.opacity is wall.view.opacity
    assert np.array_equal(view.confidence, confidence(wall.view.depth, wall.view.opacity))


def test_the_renderer_is_asked_for_the_camera_and_quality_given():
    wall, half = Wall(), Quality(detail=0.5)
    render_field_view(wall, CAMERA)
    render_field_view(wall, CAMERA, half)
    assert wall.asked == [(CAMERA, FULL), (CAMERA, half)]


class Darker:
    """A proxy that overrides the documented method and forwards everything else."""

    def __init__(self, renderer: object) -> None:
        self._renderer = renderer

    def __getattr__(self, name: str) -> object:
        return getattr(self._renderer, name)

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        view = self._renderer.render(camera, quality)
        return replace(view, colour=view.colour / 2)


def test_a_proxy_that_renders_otherwise_is_what_is_used():
    """Splats have a quicker way than ``render``, which the proxy forwards, too."""
    field = SplatField(make_gaussians(500, 1))
    camera = Camera(Intrinsics(32, 32, 16.0, 16.0, 16.0, 16.0), Pose((0, 0, -3), (1, 0, 0, 0)))
    shown = render_field_view(Darker(field), camera).render
    half = i420_from_colour(field.render(camera, FULL).colour / 2)
    assert shown.digest() == half.digest() != render_field_view(field, camera).render.digest()


def test_a_view_covers_what_is_more_opaque_than_asked():
    view = render_field_view(Wall(), CAMERA)
    assert view.covers(0.5).all()
    assert not view.covers(0.75).any()


def test_a_view_without_opacity_has_no_confidence_to_give():
    view = replace(render_field_view(Wall(), CAMERA), opacity=None)
    with pytest.raises(InvalidInput, match="opacity: was dropped"):
        _ = view.confidence
    with pytest.raises(InvalidInput, match="opacity: was dropped"):
        view.covers(0.5)


@pytest.mark.parametrize("name", ["colour", "depth"])
def test_a_renderer_that_returns_numbers_that_are_none_is_refused(name):
    wall = Wall()
    bad = getattr(wall.view, name).copy()
    bad[2, 3] = np.nan
    wall.view = replace(wall.view, **{name: bad})
    with pytest.raises(InvalidInput, match=f"{name}: [13] of .* NaN or infinite"):
        render_field_view(wall, CAMERA)


def test_a_camera_of_another_size_is_refused():
    small = Camera(Intrinsics(8, 6, 8.0, 8.0, 4.0, 3.0), CAMERA.world_from_cam)
    with pytest.raises(InvalidInput, match=r"render: \(10, 6\) px of a camera of \(8, 6\) px"):
        render_field_view(Wall(), small)
