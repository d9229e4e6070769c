"""Degenerate Gaussians and cameras: finite pictures, finite steps, the same bytes everywhere."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.backend import available_isas
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import LearningRates, TrainableRasterizer
from rfcore.views import View
from tests.raster.conftest import scene

F32 = np.float32
CAMERA = Camera(Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0), Pose.identity())
FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def poisoned(gaussians: Gaussians, name: str, values: object, every: int = 1) -> Gaussians:
    array = getattr(gaussians, name).copy()
    array[::every] = values
    return replace(gaussians, **{name: array})


POISONS: dict[str, tuple[str, object]] = {
    "needle": ("log_scales", (2.0, -18.0, -18.0)),
    "disc": ("log_scales", (1.0, 1.0, -18.0)),
    "zero size": ("log_scales", (-40.0, -40.0, -40.0)),
    "immense": ("log_scales", (40.0, 40.0, 40.0)),
    "immense needle": ("log_scales", (40.0, -40.0, -40.0)),
    "ten kilometres": ("log_scales", np.log(1e4)),
    "largest float scale": ("log_scales", 3e38),
    "zero quaternion": ("quaternions", 0.0),
    "tiny quaternion": ("quaternions", (1e-30, 2e-30, 0.0, -1e-30)),
    "subnormal quaternion": ("quaternions", 1e-41),
    "long quaternion": ("quaternions", (1e15, -2e15, 3e15, 0.0)),
    "overflowing quaternion": ("quaternions", 3e38),
    "surely opaque": ("opacity_logits", 30.0),
    "surely transparent": ("opacity_logits", -30.0),
    "beyond opaque": ("opacity_logits", 3e38),
    "at the camera": ("means", (0.0, 0.0, 0.0)),
    "on the near plane": ("means", (0.0, 0.0, 0.01)),
    "just behind it": ("means", (0.001, 0.0, 0.009999)),
    "just before it": ("means", (0.001, -0.002, 0.010001)),
    "far off axis": ("means", (1e6, -1e6, 0.02)),
    "a thousand kilometres away": ("means", (10.0, 10.0, 1e6)),
    "beyond every plane": ("means", (1.0, 1.0, 3e38)),
    "at infinity sideways": ("means", (3e38, 3e38, 1.0)),
    "all at one point": ("means", (0.1, 0.1, 3.0)),
    "blinding": ("sh", 3e38),
    "blinding both ways": ("sh", np.array([3e38, -3e38, 1e20])),
}


@pytest.mark.parametrize("kind", POISONS)
@pytest.mark.parametrize("every", [1, 5])
def test_a_degenerate_scene_renders_finite_and_equal_everywhere(
    kind, every, antialiased, forward_isa
):
    gaussians = poisoned(scene(64), *POISONS[kind], every=every)
    rasterizer = Rasterizer(gaussians, isa=forward_isa, threads=2, antialiased=antialiased)
    view = rasterizer.render(CAMERA)
    assert np.isfinite(view.colour).all()
    assert np.isfinite(view.depth).all()
    assert view.opacity.min() >= 0
    assert view.opacity.max() <= 1
    definition = Rasterizer(gaussians, isa="scalar", antialiased=antialiased).render(CAMERA)
    assert view_bytes(view) == view_bytes(definition)


@pytest.mark.parametrize("kind", POISONS)
def test_training_on_a_degenerate_scene_keeps_every_parameter_finite(kind, antialiased):
    gaussians = poisoned(scene(64), *POISONS[kind], every=3)
    target = np.random.default_rng(0).random((24, 40, 3), dtype=F32)
    results = []
    for isa in available_isas():
        trainable = TrainableRasterizer(gaussians, isa=isa, antialiased=antialiased)
        for _ in range(3):
            trainable.iterate(CAMERA, target, LearningRates(means=1e-2))
        after = trainable.gaussians()  # Gaussians refuses what is not finite
        results.append(b"".join(getattr(after, name).tobytes() for name in FIELDS))
    assert len(set(results)) == 1


def test_a_needle_along_the_diagonal_keeps_the_width_of_a_pixel():
    """In float32 c_xx c_yy - c_xy^2 of this one has no correct digit; the sum of minors does."""
    half = np.sin(np.pi / 8)
    needle = Gaussians(
        np.array([[0, 0, 2]], F32),
        np.array([[np.cos(np.pi / 8), 0, 0, half]], F32),
        np.array([[np.log(1e3), -12.0, -12.0]], F32),
        np.array([4.0], F32),
        np.zeros((1, 1, 3), F32),
    )
    opacity = Rasterizer(needle).render(CAMERA).opacity
    for offset, expected in ((0, 1.0), (1, np.exp(-0.5 * 0.5 / 0.3)), (2, np.exp(-0.5 * 2 / 0.3))):
        along = [opacity[12 + k, 20 + k + offset] for k in range(-8, 8)]
        assert along == pytest.approx([0.982 * expected] * 16, abs=2e-3)


@pytest.mark.parametrize("size_px", [(1, 1), (8192, 1), (1, 8192), (17, 1), (4097, 20)])
def test_pictures_of_extreme_shape_are_rendered_to_their_last_pixel(size_px, forward_isa):
    width, height = size_px
    focal = 0.6 * max(size_px)
    camera = Camera(
        Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height), Pose.identity()
    )
    wall = poisoned(poisoned(scene(30), "log_scales", 4.0), "opacity_logits", 2.0)
    view = Rasterizer(wall, threads=2, isa=forward_isa).render(camera)
    assert view.colour.shape == (height, width, 3)
    assert view.opacity.min() > 0.99
    assert view_bytes(view) == view_bytes(Rasterizer(wall, isa="scalar").render(camera))


def view_bytes(view: View) -> bytes:
    return view.colour.tobytes() + view.depth.tobytes() + view.opacity.tobytes()
