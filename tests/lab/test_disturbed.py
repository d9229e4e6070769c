"""Disturbed poses have the declared size, and bits are compared at one quality."""

import math

import numpy as np
import pytest

from lab.robust.run import PoseNoise, kbit_at, noisy_cameras
from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfedge.evaluate.clips import CodedClip

K = Intrinsics(64, 36, 50.0, 50.0, 32.0, 18.0)
CAMERAS = [Camera(K, Pose((1.0 * k, 2.0, 3.0), (0.8, 0.0, 0.6, 0.0))) for k in range(2000)]


def moved(noise, seed=0):
    """Return distances in metres and angles in degrees from where the cameras were."""
    metres, degrees = [], []
    for before, after in zip(CAMERAS, noisy_cameras(CAMERAS, noise, seed), strict=True):
        step = before.world_from_cam.inverse().compose(after.world_from_cam)
        metres.append(math.dist(step.translation_m, (0, 0, 0)))
        degrees.append(math.degrees(2 * math.acos(min(1.0, abs(step.rotation[0])))))
    return np.array(metres), np.array(degrees)


def test_noise_has_the_declared_deviation_per_axis():
    metres, degrees = moved(PoseNoise(0.1, 0.5))
    assert math.sqrt(np.mean(metres**2) / 3) == pytest.approx(0.1, rel=0.03)
    assert math.sqrt(np.mean(degrees**2) / 3) == pytest.approx(0.5, rel=0.03)


def test_twice_the_noise_moves_each_camera_twice_as_far():
    (near, turned), (far, more) = moved(PoseNoise(0.1, 0.1)), moved(PoseNoise(0.2, 0.2))
    np.testing.assert_allclose(far, 2 * near, rtol=1e-9)
    np.testing.assert_allclose(more, 2 * turned, rtol=1e-3)


def clip(kbit, psnr_db):
    mse = 255.0**2 / 10 ** (psnr_db / 10)
    sizes = np.array([10**6, 125 * kbit, 125 * kbit])
    return CodedClip(1.0, sizes, np.array([0.0, mse, mse]), np.ones(3), 1.0)


def test_bits_are_interpolated_in_the_logarithm_without_the_first_frame():
    clips = [clip(80, 36), clip(20, 32)]
    assert kbit_at(clips, 34) == pytest.approx(40)
    assert kbit_at(clips, 36) == pytest.approx(80)


def test_a_quality_that_was_not_reached_is_an_error():
    with pytest.raises(InvalidInput, match=r"30 dB is outside the 32\.00\.\.36\.00"):
        kbit_at([clip(80, 36), clip(20, 32)], 30)
