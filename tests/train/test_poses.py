"""Poses learned with the field: gradients against differences, wrong poses found again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.motion import quaternion_from_vector
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.trainable import TrainableRasterizer
from rfcore.train.poses import (
    PoseModel,
    align_pictures,
    corrected,
    pose_gradient,
    typical_depth_m,
)
from rfcore.train.schedule import Bands
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.views import PosedPicture

K = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
CAMERA = Camera(K, Pose((0.1, -0.2, 0.3), quaternion_from_vector((0.05, -0.1, 0.02))))


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return splats(400, -1.7)


def splats(n: int, log_scale: float) -> Gaussians:
    rng = np.random.default_rng(3)
    sh = np.zeros((n, 1, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.5, 1.5, (n, 3))
    return Gaussians(
        means=rng.uniform([-3, -2, 3], [3, 2, 7], (n, 3)).astype(np.float32),
        quaternions=rng.normal(size=(n, 4)).astype(np.float32),
        log_scales=(log_scale + rng.uniform(-0.5, 0.5, (n, 3))).astype(np.float32),
        opacity_logits=np.full(n, 1.5, np.float32),
        sh=sh,
    )


def picture(field: SplatField, camera: Camera, name: str = "0.png") -> PosedPicture:
    rgb = np.clip(field.render_colour(camera) * 255 + 0.5, 0, 255).astype(np.uint8)
    return PosedPicture(name, camera, lambda: rgb)


def test_the_gradient_is_that_of_differences():
    """It is that of a weighted sum; splats are so large that few edges pass through pixels."""
    scene = splats(40, -0.6)
    rasterizer = TrainableRasterizer(scene)
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:48, 0:64]
    waves = [np.cos(0.1 * a * x + 0.13 * b * y) for a, b in rng.uniform(-1, 1, (3, 2))]
    weight = np.ascontiguousarray(np.stack(waves, axis=2), np.float32)

    def value(camera: Camera) -> float:
        return float((rasterizer.forward(camera).colour.astype(np.float64) * weight).sum())

    value(CAMERA)
    rasterizer.backward(weight)
    found = pose_gradient(scene, rasterizer.gradients(), CAMERA.world_from_cam.translation_m)
    step = 1e-2
    sides = [value(corrected(CAMERA, s * step * axis)) for axis in np.eye(6) for s in (1, -1)]
    differences = (np.array(sides[::2]) - np.array(sides[1::2])) / (2 * step)
    # Splats end where they are fainter than 1/255: small steps of the sum remain.
    assert found == pytest.approx(differences, rel=0.04, abs=0.01 * np.abs(differences).max())


def test_no_gradient_moves_nothing(scene):
    rasterizer = TrainableRasterizer(scene)
    rasterizer.forward(CAMERA)
    rasterizer.backward(np.zeros((48, 64, 3), np.float32))
    assert not pose_gradient(scene, rasterizer.gradients(), (0.0, 0.0, 0.0)).any()


def test_a_picture_is_aligned_with_a_field_that_is_held(scene):
    field = SplatField(scene)
    taken = picture(field, CAMERA)
    off = corrected(CAMERA, np.array([0.03, -0.02, 0.02, 0.004, -0.006, 0.003]))
    aligned = align_pictures(field, [replace(taken, camera=off)], 5.0, 1)[0].camera
    assert _displaced_px(scene, aligned) < 0.25 * _displaced_px(scene, off)


def _displaced_px(scene: Gaussians, camera: Camera) -> float:
    """Mean displacement of the scene's points in the picture, from where ``CAMERA`` sees them."""
    points = scene.means[::4].tolist()
    pairs = [(camera.project(point), CAMERA.project(point)) for point in points]
    return float(np.mean([math.dist(a[:2], b[:2]) for a, b in pairs]))


def test_corrections_have_mean_zero():
    cameras = [CAMERA, CAMERA, CAMERA]
    model = PoseModel(cameras, 5.0)
    for n in range(9):
        model.step(n % 3, np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.1]) * (n % 3 + 1), 0.1)
    moved = [np.array(model.camera(v).world_from_cam.translation_m) for v in range(3)]
    assert np.mean(moved, axis=0) == pytest.approx(CAMERA.world_from_cam.translation_m, abs=1e-12)


def test_a_run_goes_on_from_its_arrays():
    one, other = (PoseModel([CAMERA, CAMERA], 5.0) for _ in range(2))
    gradients = np.random.default_rng(2).normal(size=(6, 6))
    for n, gradient in enumerate(gradients[:3]):
        one.step(n % 2, gradient, 0.1)
    other.adam.restore(one.adam.arrays())
    for n, gradient in enumerate(gradients[3:]):
        one.step(n % 2, gradient, 0.5)
        other.step(n % 2, gradient, 0.5)
    assert one.camera(0) == other.camera(0)
    assert one.camera(1) == other.camera(1)


@pytest.mark.parametrize("halved_until", [(), (0.5,)])
def test_training_with_wrong_poses_ends_nearer_to_the_right_ones(scene, halved_until):
    """Relative to each other: the mean of all corrections is held."""
    field, rng = SplatField(scene), np.random.default_rng(9)
    cameras = [
        Camera(K, Pose((0.3 * n - 1.0, 0.05 * n, 0.0), quaternion_from_vector((0, 0.02 * n, 0))))
        for n in range(8)
    ]
    errors = rng.normal(size=(8, 6)) * ([0.03] * 3 + [0.005] * 3)
    errors -= errors.mean(axis=0)
    taken = [
        replace(picture(field, camera, f"{n}.png"), camera=corrected(camera, error))
        for n, (camera, error) in enumerate(zip(cameras, errors, strict=True))
    ]
    config = SplatTrainingConfig(
        iterations=400,
        bands=Bands(0, 0.0),
        halved_until=halved_until,
        refine_poses=True,
    )
    trainer = SplatTrainer(taken, scene, config, seed=1)
    assert trainer.depth_m == pytest.approx(typical_depth_m(scene, cameras), rel=0.05)
    for _ in trainer.steps():
        pass
    before, after = (
        [
            math.hypot(*camera.world_from_cam.inverse().compose(c.world_from_cam).translation_m)
            for camera, c in zip(cameras, found, strict=True)
        ]
        for found in ([p.camera for p in taken], trainer.cameras())
    )
    assert np.mean(after) < 0.5 * np.mean(before)
    assert len(trainer.pose_corrections()) == 8
    assert trainer.checkpoint().arrays["poses.values"].shape == (8, 6)


def test_poses_and_exposure_are_not_learned_together():
    with pytest.raises(InvalidInput, match="refine_poses"):
        SplatTrainingConfig(refine_poses=True, exposure=True)
