"""Points made from depth lie on the surface; random points lie where several cameras look."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import SKY_M
from rfcore.train.start import (
    RandomStart,
    looking_distance_m,
    points_from_depth,
    random_points,
    sky_gaussians,
)
from rfcore.train.targets import Target

K = Intrinsics(40, 24, 30.0, 30.0, 20.0, 12.0)


def paint(level: int) -> np.ndarray:
    return np.full((24, 40, 3), level, np.uint8)


def looking_inwards(count: int, radius_m: float) -> list[Camera]:
    """Cameras on a circle in the plane z = 0, looking at its centre."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        half = angle / 2  # a turn about y, from looking along +z
        at = (-radius_m * np.sin(angle), 0.0, -radius_m * np.cos(angle))
        cameras.append(Camera(K, Pose(at, (np.cos(half), 0.0, np.sin(half), 0.0))))
    return cameras


def test_a_depth_map_of_a_wall_gives_points_on_the_wall():
    half = np.pi / 8
    camera = Camera(K, Pose((1.0, -2.0, 0.5), (np.cos(half), 0.0, np.sin(half), 0.0)))
    cloud = points_from_depth(camera, paint(80), np.full((24, 40), 3.0, np.float32), 4)
    pose = camera.cam_from_world()
    in_camera = cloud.xyz_m @ np.array(pose.rotation_matrix()).T + pose.translation_m
    np.testing.assert_allclose(in_camera[:, 2], 3.0, rtol=1e-5)
    u = 30.0 * in_camera[:, 0] / 3.0 + 20.0
    np.testing.assert_allclose(np.unique(np.round(u, 3)), np.arange(2, 40, 4) + 0.5)
    assert len(cloud.rgb) == 6 * 10
    assert (cloud.rgb == 80).all()


def test_pixels_without_depth_give_no_points():
    depth = np.zeros((24, 40), np.float32)
    depth[3, 5], depth[4, 6] = 2.0, np.nan
    camera = Camera(K, Pose((0, 0, 0), (1.0, 0, 0, 0)))
    assert len(points_from_depth(camera, paint(1), depth, 1).xyz_m) == 1
    with pytest.raises(InvalidInput, match="depth"):
        points_from_depth(camera, paint(1), depth[:5], 1)


@pytest.mark.parametrize("radius_m", [0.5, 40.0])
def test_cameras_in_a_circle_look_at_its_centre(radius_m):
    assert looking_distance_m(looking_inwards(7, radius_m)) == pytest.approx(radius_m)


def test_cameras_side_by_side_have_a_distance_of_their_own(cameras):
    assert looking_distance_m(cameras) == 1.0


def test_random_points_are_in_view_of_enough_cameras_and_coloured(posed):
    pictures = posed(lambda i: paint(10 * i))
    cloud = random_points(pictures, 300, np.random.default_rng(0), RandomStart(seen_by=3))
    assert len(cloud.xyz_m) == 300
    assert set(np.unique(cloud.rgb)) <= {0, 10, 20, 30}
    views = np.zeros(300)
    for picture in pictures:
        pose = picture.camera.cam_from_world()
        x, y, z = (cloud.xyz_m @ np.array(pose.rotation_matrix()).T + pose.translation_m).T
        u, v = 30 * x / z + 20, 30 * y / z + 12
        # Half a pixel of room: the points were rounded to float32.
        views += (z > 0) & (abs(u - 20) < 20.01) & (abs(v - 12) < 12.01)
    assert views.min() >= 3


def test_the_same_generator_gives_the_same_points(posed):
    pictures = posed(lambda i: paint(10 * i))
    first, again = (random_points(pictures, 50, np.random.default_rng(2)) for _ in range(2))
    np.testing.assert_array_equal(first.xyz_m, again.xyz_m)


def test_cameras_with_nothing_in_common_are_refused(posed):
    from dataclasses import replace

    pictures = posed(lambda _: paint(0))
    back = Camera(K, Pose((0, 0, -50.0), (0.0, 0, 1.0, 0)))
    apart = (pictures[0], replace(pictures[1], camera=back))
    with pytest.raises(InvalidInput, match="common view"):
        random_points(apart, 100, np.random.default_rng(0))


@pytest.mark.parametrize("change", [{"nearest": 0.0}, {"farthest": 0.1}, {"seen_by": 0}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(InvalidInput, match="start"):
        RandomStart(**change)


def ray_directions(camera: Camera) -> np.ndarray:
    u, v = np.meshgrid(np.arange(40) + 0.5 - 20, np.arange(24) + 0.5 - 12)
    rays = np.stack([u / 30, v / 30, np.ones_like(u)], axis=-1)
    return rays @ np.array(camera.world_from_cam.rotation_matrix()).T


def cloudy(towards: np.ndarray) -> np.ndarray:
    """The colour of the sky [..., 3] in each direction, smooth over some degrees."""
    x, y, z = np.moveaxis(towards / np.linalg.norm(towards, axis=-1, keepdims=True), -1, 0)
    return 128 + 60 * np.stack([np.sin(5 * x + z), np.cos(4 * y), np.sin(6 * y - 3 * x)], axis=-1)


def before_clouds(camera: Camera, wall_m: float = 3.0) -> Target:
    """Return pictures of the sky over a textured wall, whose top is at the camera's height."""
    rays, x_m = ray_directions(camera), camera.world_from_cam.translation_m[0]
    across = (x_m + wall_m * rays[..., 0] / rays[..., 2]) / 0.05
    down = wall_m * rays[..., 1] / rays[..., 2] / 0.05
    stones = np.random.default_rng(1).uniform(0, 255, (500, 100, 3))
    texture = stones[np.floor(across).astype(int) % 500, np.floor(down).astype(int) % 100]
    is_wall = (rays[..., 1] > 0)[..., None]
    picture = np.where(is_wall, texture, cloudy(rays))
    return Target(camera, np.round(picture).astype(np.uint8))


def test_the_sky_is_where_pictures_from_places_apart_agree(cameras):
    sky = sky_gaussians([before_clouds(camera) for camera in cameras], 20_000, 0.6, sh_degree=2)
    towards = sky.means.astype(np.float64) / np.linalg.norm(sky.means, axis=1, keepdims=True)
    x, y, z = towards.T
    is_inside = (z > 0) & (np.abs(x) < 0.6 * z) & (np.abs(y) < 0.36 * z)
    above, below = y < -0.05 * z, y > 0.05 * z  # a pixel and a half from the edge
    assert (above & is_inside).sum() > 0.9 * 20_000 * 0.3 / (4 * np.pi)  # a third of a steradian
    assert below.mean() < 0.05
    shown = 255 * (0.5 + sky.sh[above, 0] * np.sqrt(1 / (4 * np.pi)))
    assert np.abs(shown - cloudy(towards[above])).mean() < 4
    assert not sky.sh[:, 1:].any()
    assert sky.means[:, 2].min() > SKY_M


def test_no_sky_is_seen_from_one_place(cameras):
    """There all agree about everything."""
    assert len(sky_gaussians([before_clouds(cameras[0])] * 3, 5000, 0.6)) == 0


def test_a_wall_that_fills_all_pictures_is_no_sky(cameras):
    rng = np.random.default_rng(3)
    noise = [Target(c, rng.integers(0, 256, (24, 40, 3), dtype=np.uint8)) for c in cameras]
    assert len(sky_gaussians(noise, 5000, 0.6)) < 5


@pytest.mark.parametrize("directions", [1, 3, 4096, 9000])
def test_directions_are_spread_evenly(directions):
    """All directions in view of a white world are kept: their share of the sphere."""
    at = [Camera(K, Pose((x, 0.0, 0.0), (1.0, 0, 0, 0))) for x in (0.0, 5.0)]
    sky = sky_gaussians([Target(camera, paint(255)) for camera in at], directions, 0.6)
    corner = np.arcsin(20 * 12 / np.sqrt((30**2 + 20**2) * (30**2 + 12**2)))
    assert abs(len(sky) - directions * 4 * corner / (4 * np.pi)) <= 1 + 0.02 * directions**0.5 * 5
