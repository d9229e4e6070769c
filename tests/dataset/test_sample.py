"""The committed sample is whole, and its poses fit its pictures."""

from pathlib import Path

import numpy as np
import pytest

from rfcore.camera import Camera
from rfcore.dataset import read_dataset, verify_manifest
from rfcore.views import PointCloud, PosedPicture

SAMPLE = Path(__file__).parents[2] / "samples" / "street"

pytestmark = pytest.mark.sample


def test_every_file_is_as_it_was_listed():
    verify_manifest(SAMPLE)


def test_the_two_drives_take_the_same_path():
    empty, vehicles = (
        read_dataset(SAMPLE / f"transforms_drive_{name}.json").pictures
        for name in ("empty", "vehicles")
    )
    assert [p.camera for p in empty] == [p.camera for p in vehicles]
    assert (empty[0].read() != vehicles[0].read()).any()


def test_the_points_have_the_colour_of_the_pixels_they_land_on():
    """The nearest point of each 8x8 px; with the pose of another view they are far off."""
    train = read_dataset(SAMPLE / "transforms_train.json")
    assert train.points is not None
    for picture, other in zip(train.pictures[::40], train.pictures[20::40], strict=True):
        error = median_colour_error(picture, picture.camera, train.points)
        assert error < 10
        assert median_colour_error(picture, other.camera, train.points) > 4 * error


def median_colour_error(picture: PosedPicture, camera: Camera, points: PointCloud) -> float:
    u, v, depth_m = projected(camera, points.xyz_m)
    rgb = picture.read()
    height, width = rgb.shape[:2]
    seen = (depth_m > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v, depth_m, colour = (
        u[seen].astype(int),
        v[seen].astype(int),
        depth_m[seen],
        points.rgb[seen],
    )
    nearest_first = np.argsort(depth_m, kind="stable")
    _, first = np.unique((v // 8 * width + u // 8)[nearest_first], return_index=True)
    shown = nearest_first[first]
    there = rgb[v[shown], u[shown]]
    return float(np.median(np.abs(there.astype(int) - colour[shown])))


def projected(camera: Camera, xyz_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixel columns, rows and depths in metres of points, as ``Camera.project`` has them."""
    k, cam_from_world = camera.intrinsics, camera.world_from_cam.inverse()
    rotation = np.array(cam_from_world.rotation_matrix())
    x, y, z = (xyz_m @ rotation.T + np.array(cam_from_world.translation_m)).T
    z = np.where(z == 0, np.nan, z)
    return k.fx_px * x / z + k.cx_px, k.fy_px * y / z + k.cy_px, z
