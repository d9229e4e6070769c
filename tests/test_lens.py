"""Lenses agree with OpenCV's definition, are inverted exactly, and say where they end."""

import math
from dataclasses import astuple

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.lens import BrownLens, FisheyeLens, Lens, LensCamera

FOX = BrownLens(k1=0.0578421, k2=-0.0805099, p1=-0.000980296, p2=0.00015575)
BARREL = BrownLens(k1=-0.28, k2=0.07, p1=2e-4, p2=3e-5, k3=-0.01)
FISHEYE = FisheyeLens(k1=-0.02, k2=0.004, k3=-0.003, k4=0.0005)
RATIONAL = BrownLens(0.4, 0.1, 0.01, -0.02, 0.02, 0.6, 0.15, 0.03, 0.03, 0.01, -0.04, 0.02)
LENSES: list[Lens] = [FOX, BARREL, RATIONAL, FISHEYE, FisheyeLens()]

direction = st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))


def grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.7, 0.7, 15))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("lens", [FOX, BARREL, RATIONAL])
def test_brown_is_opencv(lens):
    points = np.concatenate([grid(), np.ones((225, 1))], axis=1)
    coefficients = np.array(astuple(lens))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)
    np.testing.assert_allclose(lens.distort(grid()), expected[:, 0], atol=1e-13)


def test_fisheye_is_opencv():
    points = np.concatenate([grid(), np.ones((225, 1))], axis=1)[:, None]
    coefficients = np.array([FISHEYE.k1, FISHEYE.k2, FISHEYE.k3, FISHEYE.k4])
    expected, _ = cv2.fisheye.projectPoints(
        points, np.zeros((3, 1)), np.zeros((3, 1)), np.eye(3), coefficients
    )
    np.testing.assert_allclose(FISHEYE.distort(grid()), expected[:, 0], atol=1e-13)


@pytest.mark.parametrize("lens", LENSES)
@given(xy=direction)
def test_undistortion_undoes_distortion(lens, xy):
    there = lens.distort(np.array([xy]))
    np.testing.assert_allclose(lens.undistort(there)[0], xy, atol=1e-9)


def test_the_radius_of_a_fisheye_without_coefficients_is_the_angle():
    there = FisheyeLens().distort(np.array([[math.tan(1.2), 0.0]]))
    np.testing.assert_allclose(there, [[1.2, 0.0]])


def test_a_lens_ends_where_it_turns_back():
    """r (1 - r^2 / 3) is largest at r = 1."""
    lens = BrownLens(k1=-1 / 3)
    assert lens.max_radius == pytest.approx(1.0)
    with pytest.raises(InvalidInput, match="not one-to-one"):
        lens.undistort(np.array([[0.7, 0.0]]))
    assert BrownLens(k1=0.1).max_radius == math.inf
    assert BrownLens(k4=1.0).max_radius == pytest.approx(1.0)  # r / (1 + r^2)
    assert BrownLens(k4=-0.25).max_radius == pytest.approx(2.0)  # a pole
    assert FisheyeLens().max_radius == math.inf
    assert FisheyeLens(k1=-1 / 3).max_radius == pytest.approx(math.tan(1.0))
    with pytest.raises(InvalidInput, match="not one-to-one"):
        FisheyeLens().undistort(np.array([[1.6, 0.0]]))


@pytest.mark.parametrize("lens", [BrownLens, FisheyeLens])
def test_a_coefficient_that_is_not_finite_is_refused(lens):
    with pytest.raises(InvalidInput, match="not finite"):
        lens(k2=math.nan)


@pytest.mark.parametrize("lens", [FOX, FISHEYE])
def test_a_pixel_looks_back_at_the_point_that_lands_on_it(lens):
    pose = Pose.from_matrix([[0, 0, 1, 5], [-1, 0, 0, 6], [0, -1, 0, 7]])
    camera = LensCamera(Intrinsics(640, 360, 400.0, 410.0, 322.0, 178.0), lens, pose)
    point = (15.0, 4.0, 8.5)
    u_px, v_px, depth_m = camera.project(point)
    plain = Camera(camera.intrinsics, pose).project(point)
    assert depth_m == plain[2] == pytest.approx(10.0)
    assert abs(u_px - plain[0]) + abs(v_px - plain[1]) > 0.05, "the lens moves it"
    x, y, _ = camera.ray(u_px, v_px)
    assert pose.apply((x * depth_m, y * depth_m, depth_m)) == pytest.approx(point, abs=1e-9)


def test_a_point_behind_the_camera_has_no_pixel():
    camera = LensCamera(Intrinsics(64, 64, 40.0, 40.0, 32.0, 32.0), FOX, Pose.identity())
    assert math.isnan(camera.project((0.1, 0.1, -1.0))[0])
