"""Cameras made for a field look at its middle, upright."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import FieldMetadata, SplatField
from rfcore.raster.gaussians import Gaussians
from rfcore.vertical import Z_UP, Sight, first_sight, seen_point, sights_of
from rfedge.fields.viewpoints import UPS, OrbitSettings, look_around, looking_at, orbit


@pytest.mark.parametrize("up", sorted(UPS))
def test_an_orbit_keeps_the_middle_in_the_middle_and_up_upright(place, up):
    middle = np.median(place.field.gaussians.means, axis=0)
    cameras = orbit(place.field, OrbitSettings(frames=7, width_px=64, height_px=48, up=up)).cameras
    assert len(cameras) == 7
    for camera in cameras:
        u_px, v_px, depth_m = camera.project(middle.tolist())
        assert (u_px, v_px) == pytest.approx((32, 24), abs=1e-6)
        assert depth_m > 0
        _, above_px, _ = camera.project((middle + 0.1 * np.array(UPS[up])).tolist())
        assert above_px < v_px, "what is higher is higher in the picture"


OBJECT_M = np.array([2.0, -3.0, 1.0])


def photographed(azimuths_deg, turn: Pose) -> SplatField:
    """A field of one splat that was photographed from these sides, 4 m away and from 1 m above."""
    sights = []
    for azimuth in np.radians(azimuths_deg):
        eye = OBJECT_M + np.array([4 * np.cos(azimuth), 4 * np.sin(azimuth), 1.0])
        pose = turn.compose(looking_at(eye, OBJECT_M + 0.05, np.array(Z_UP)))
        sights.append(Camera(Intrinsics(8, 8, 8.0, 8.0, 4.0, 4.0), pose))
    nothing = Gaussians(*(np.zeros((0, *s), "f4") for s in ((3,), (4,), (3,), (), (1, 3))))
    return SplatField(nothing, FieldMetadata(up=rotated(turn, Z_UP), sights=sights_of(sights)))


def rotated(turn: Pose, vector):
    return Pose((0.0, 0.0, 0.0), turn.rotation).apply(vector)


ASKEW = Pose((3.0, -7.0, 2.0), (0.1, -0.7, 0.5, 0.5))


@pytest.mark.parametrize("turn", [Pose.identity(), ASKEW], ids=["z up", "askew"])
def test_an_orbit_of_an_object_stays_where_it_was_photographed_from(turn):
    """From a quarter of its sides: to and fro between them."""
    field = photographed(np.linspace(-45, 45, 9), turn)
    for camera in orbit(field, OrbitSettings(frames=12, width_px=64, height_px=48)).cameras:
        u_px, v_px, depth_m = camera.project(turn.apply(OBJECT_M))
        assert (u_px, v_px) == pytest.approx((32, 24), abs=2)
        assert depth_m == pytest.approx(np.hypot(4, 1), abs=0.2)
        x_m, y_m, z_m = np.subtract(
            turn.inverse().apply(camera.world_from_cam.translation_m), OBJECT_M
        )
        assert abs(np.degrees(np.arctan2(y_m, x_m))) < 48
        assert z_m == pytest.approx(1.0, abs=0.1)


def test_an_orbit_of_an_object_photographed_all_around_goes_all_around():
    field = photographed(np.arange(0, 360, 45), Pose.identity())
    eyes = [c.world_from_cam.translation_m for c in orbit(field, OrbitSettings(frames=8)).cameras]
    sides = np.degrees([np.arctan2(y + 3, x - 2) for x, y, _ in eyes])
    np.testing.assert_allclose(np.diff(np.sort(sides)), 45, atol=3)


def test_a_street_has_no_point_that_its_cameras_look_at():
    """Neither on the way ahead, nor there and back, nor at a turn."""
    ahead = [Sight((float(x), 0.0, 1.5), (1.0, 0.0, 0.0)) for x in range(8)]
    back = [Sight(sight.eye_m, (-1.0, 0.0, 0.0)) for sight in ahead]
    turn = [
        Sight((np.sin(a), -np.cos(a), 1.5), (np.cos(a), np.sin(a), 0.0)) for a in (0.0, 0.5, 1.0)
    ]
    for sights in (ahead, ahead + back, turn, ahead[:2]):
        assert seen_point(sights) is None


def test_a_field_is_first_seen_by_the_camera_that_aims_best_or_by_the_middle_one():
    sights = list(photographed(np.linspace(-45, 45, 8), Pose.identity()).metadata.sights)
    aside = Sight(sights[4].eye_m, (-0.8, 0.6, 0.0))
    sights.insert(4, aside)
    assert seen_point(sights) is not None
    assert first_sight(sights) not in (aside, None)
    ahead = [Sight((float(x), 0.0, 1.5), (1.0, 0.0, 0.0)) for x in range(5)]
    assert first_sight(ahead) == ahead[2]
    assert first_sight([]) is None


def test_an_orbit_stays_behind_cameras_that_all_look_one_way(place):
    way = rotated(ASKEW, (1.0, 0.0, 0.0))
    metadata = FieldMetadata(up=rotated(ASKEW, Z_UP), sights=(Sight((0.0, 0.0, 0.0), way),) * 4)
    cameras = orbit(place.field.described(metadata), OrbitSettings(frames=8)).cameras
    ahead = [np.array(c.world_from_cam.rotation_matrix())[:, 2] @ way for c in cameras]
    assert min(ahead) > 0.7


def test_four_cameras_look_around_from_the_middle(place):
    cameras = look_around(place.field, 640, 360)
    middle = np.median(place.field.gaussians.means, axis=0)
    ways = [np.array(c.world_from_cam.rotation_matrix())[:, 2] for c in cameras]
    np.testing.assert_allclose([c.world_from_cam.translation_m for c in cameras], [middle] * 4)
    np.testing.assert_allclose(ways[0], -ways[2], atol=1e-12)
    np.testing.assert_allclose(np.dot(ways[0], ways[1]), 0, atol=1e-12)
    assert all(place.field.render(c).opacity.mean() > 0.2 for c in cameras)


@pytest.mark.parametrize("is_object", [False, True])
def test_a_given_centre_and_radius_are_kept(place, is_object):
    field = photographed([-20, 0, 20], Pose.identity()) if is_object else place.field
    settings = OrbitSettings(frames=7, centre_m=(4.0, -5.0, 6.0), radius_m=2.5)
    for camera in orbit(field, settings).cameras:
        pose = camera.world_from_cam
        ahead_m = pose.inverse().apply(settings.centre_m)
        assert ahead_m == pytest.approx((0.0, 0.0, 2.5), abs=1e-6)


def test_an_empty_field_can_be_orbited():
    nothing = Gaussians(*(np.zeros((0, *s), "f4") for s in ((3,), (4,), (3,), (), (1, 3))))
    assert len(orbit(SplatField(nothing), OrbitSettings(frames=2)).cameras) == 2


def test_a_camera_looks_where_it_is_told():
    pose = looking_at(np.array([1.0, 2, 3]), np.array([1.0, 7, 3]), np.array([0.0, 0, 1]))
    np.testing.assert_allclose(pose.apply((0, 0, 2)), (1, 4, 3), atol=1e-12)
    np.testing.assert_allclose(pose.apply((0, 1, 0)), (1, 2, 2), atol=1e-12)


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"up": "x"}, {"radius_m": 0.0}, {"centre_m": (np.nan, 0.0, 0.0)}]
)
def test_an_orbit_that_is_none_is_refused(wrong):
    with pytest.raises(InvalidInput, match=next(iter(wrong)).removesuffix("_m")):
        OrbitSettings(**wrong)
