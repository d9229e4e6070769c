"""Cameras made for a field look at its middle, upright."""

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.raster.gaussians import Gaussians
from rfedge.fields.viewpoints import UPS, OrbitSettings, look_around, looking_at, orbit


@pytest.mark.parametrize("up", sorted(UPS))
def test_an_orbit_keeps_the_middle_in_the_middle_and_up_upright(place, up):
    middle = np.median(place.field.gaussians.means, axis=0)
    cameras = orbit(place.field, OrbitSettings(frames=7, width_px=64, height_px=48, up=up))
    assert len(cameras) == 7
    for camera in cameras:
        u_px, v_px, depth_m = camera.project(middle.tolist())
        assert (u_px, v_px) == pytest.approx((32, 24), abs=1e-6)
        assert depth_m > 0
        _, above_px, _ = camera.project((middle + 0.1 * np.array(UPS[up])).tolist())
        assert above_px < v_px, "what is higher is higher in the picture"


def test_four_cameras_look_around_from_the_middle(place):
    cameras = look_around(place.field, 640, 360)
    middle = np.median(place.field.gaussians.means, axis=0)
    ways = [np.array(c.world_from_cam.rotation_matrix())[:, 2] for c in cameras]
    np.testing.assert_allclose([c.world_from_cam.translation_m for c in cameras], [middle] * 4)
    np.testing.assert_allclose(ways[0], -ways[2], atol=1e-12)
    np.testing.assert_allclose(np.dot(ways[0], ways[1]), 0, atol=1e-12)
    assert all(place.field.render(c).opacity.mean() > 0.2 for c in cameras)


def test_an_empty_field_can_be_orbited():
    nothing = Gaussians(*(np.zeros((0, *s), "f4") for s in ((3,), (4,), (3,), (), (1, 3))))
    assert len(orbit(SplatField(nothing), OrbitSettings(frames=2))) == 2


def test_a_camera_looks_where_it_is_told():
    pose = looking_at(np.array([1.0, 2, 3]), np.array([1.0, 7, 3]), np.array([0.0, 0, 1]))
    np.testing.assert_allclose(pose.apply((0, 0, 2)), (1, 4, 3), atol=1e-12)
    np.testing.assert_allclose(pose.apply((0, 1, 0)), (1, 2, 2), atol=1e-12)


@pytest.mark.parametrize("wrong", [{"frames": 0}, {"up": "x"}])
def test_an_orbit_that_is_none_is_refused(wrong):
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        OrbitSettings(**wrong)
