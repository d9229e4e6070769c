"""A picture does not depend on coordinates, order or units."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.motion import quaternion_from_vector
from rfcore.raster.gaussians import SKY_M, Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.views import View

pytestmark = pytest.mark.hard

INTRINSICS = Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0)
TOLERANCE = 2e-4
"""Moved means and quaternions are rounded to float32 again: 1e-6 m of 7 m, 1e-5 px of blobs whose
alpha changes by up to 1 a pixel; a pixel whose alpha crosses 1/255 may change by 0.004."""
FLIP = 2 / 255
MAX_FLIPPED = 0.01

angles = st.floats(-3.0, 3.0)
metres = st.floats(-50.0, 50.0)
seeds = st.integers(0, 1000)


def cloud(seed: int, count: int = 40) -> Gaussians:
    """Degree 0: harmonics would have to be rotated with the scene."""
    rng = np.random.default_rng(seed)
    values = (
        rng.uniform((-1.5, -1.0, 2.0), (1.5, 1.0, 7.0), (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(math.log(0.05), math.log(0.4), (count, 3)),
        rng.uniform(-2.0, 2.0, count),
        rng.uniform(-0.5, 1.5, (count, 1, 3)),
    )
    return Gaussians(*(np.ascontiguousarray(v, dtype=np.float32) for v in values))


def drawn(gaussians: Gaussians, pose: Pose | None = None) -> View:
    return Rasterizer(gaussians).render(Camera(INTRINSICS, pose or Pose.identity()))


def picked(gaussians: Gaussians, index: np.ndarray) -> Gaussians:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return Gaussians(*(np.ascontiguousarray(getattr(gaussians, name)[index]) for name in names))


def assert_alike(got: np.ndarray, want: np.ndarray) -> None:
    error = np.abs(got - want)
    assert error.max() < FLIP
    assert (error > TOLERANCE).mean() < MAX_FLIPPED


def moved(gaussians: Gaussians, pose: Pose) -> Gaussians:
    """Apply a rigid transform in float64 and round once."""
    means = gaussians.means.astype(np.float64) @ np.array(pose.rotation_matrix()).T
    turned = [
        pose.compose(Pose((0.0, 0.0, 0.0), tuple(q / np.linalg.norm(q)))).rotation
        for q in gaussians.quaternions.astype(np.float64)
    ]
    return replace(
        gaussians,
        means=(means + pose.translation_m).astype(np.float32),
        quaternions=np.array(turned, np.float32),
    )


@settings(max_examples=30)
@given(seeds, st.tuples(angles, angles, angles), st.tuples(metres, metres, metres))
def test_moving_scene_and_camera_together_changes_nothing(seed, turn, shift):
    pose = Pose(shift, quaternion_from_vector(turn))
    got = drawn(moved(cloud(seed), pose), pose)
    assert_alike(got.colour, drawn(cloud(seed)).colour)


@settings(max_examples=30)
@given(seeds, st.floats(2.0, 7.0))
def test_a_scene_split_in_depth_is_composed_again_by_over(seed, depth_m):
    """C = C_front + (1 - O_front) C_back, as long as the light does not run out on the way."""
    gaussians = replace(cloud(seed), opacity_logits=cloud(seed).opacity_logits - np.float32(2.0))
    in_front = gaussians.means[:, 2] < np.float32(depth_m)
    front, back = (drawn(picked(gaussians, index)) for index in (in_front, ~in_front))
    whole = drawn(gaussians)
    assert whole.opacity.max() < 0.999
    through = 1.0 - front.opacity[..., None]
    np.testing.assert_allclose(front.colour + through * back.colour, whole.colour, atol=3e-6)


@settings(max_examples=30)
@given(seeds, seeds)
def test_the_order_of_the_file_changes_not_a_byte(seed, shuffle):
    order = np.random.default_rng(shuffle).permutation(40)
    a, b = drawn(cloud(seed)), drawn(picked(cloud(seed), order))
    assert a.colour.tobytes() == b.colour.tobytes()
    assert a.depth.tobytes() == b.depth.tobytes()


@settings(max_examples=30)
@given(seeds, seeds)
def test_at_equal_depths_the_order_of_the_file_is_that_of_drawing(seed, shuffle):
    """Any order that keeps the coplanar ones in sequence gives the same bytes."""
    gaussians = cloud(seed)
    gaussians.means[::2, 2] = 3.0
    order = np.random.default_rng(shuffle).permutation(40)
    tied = order[order % 2 == 0]
    order[order % 2 == 0] = np.sort(tied)
    a, b = drawn(gaussians), drawn(picked(gaussians, order))
    assert a.colour.tobytes() == b.colour.tobytes()


@settings(max_examples=30)
@given(seeds, st.integers(-4, 20))
def test_a_world_of_another_unit_looks_the_same(seed, power):
    """Metres to the power of two: means scale exactly, log scales to one rounding. From 10 km on
    it is sky: the same colours and opacity, all as deep as that."""
    gaussians, scale = cloud(seed), 2.0**power
    log_scales = gaussians.log_scales.astype(np.float64) + power * math.log(2.0)
    scaled = replace(
        gaussians,
        means=gaussians.means * np.float32(scale),
        log_scales=log_scales.astype(np.float32),
    )
    got, want = drawn(scaled), drawn(gaussians)
    assert_alike(got.colour, want.colour)
    if gaussians.means[:, 2].max() * scale <= SKY_M:
        assert_alike(got.depth / scale, want.depth)
    elif gaussians.means[:, 2].min() * scale > SKY_M:
        assert_alike(got.opacity, want.opacity)
        np.testing.assert_array_equal(got.depth, np.where(want.opacity > 0, SKY_M, 0))
