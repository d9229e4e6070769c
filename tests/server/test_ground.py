"""The ground ahead of a camera is a plane near the field's, whatever single views of it say."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.perception.ground import STEPS, FieldGround, GroundPlane, points_of, rays_of
from rfcore.views import View
from server.test_objects import CAMERA_M, FIELD, camera_at

ROWS, COLUMNS = np.array([104, 110, 120, 140], np.intp), np.full(4, 160, np.intp)


def level_ground(
    camera: Camera, height_m: float = -CAMERA_M, slope: float = 0.0, shorter: float = 0.0
) -> View:
    """Opaque ground of ``height_m + slope * x`` everywhere; depths too short by a share."""
    k = camera.intrinsics
    rows, columns = (grid.ravel() for grid in np.mgrid[: k.height_px, : k.width_px])
    rays, eye_m = rays_of(camera, rows, columns), camera.world_from_cam.translation_m
    falls = rays[:, 2] - slope * rays[:, 0]
    ahead_m = (height_m + slope * eye_m[0] - eye_m[2]) / np.where(falls < -1e-3, falls, np.nan)
    depth = np.nan_to_num((1 - shorter) * ahead_m).reshape(k.height_px, k.width_px)
    shown = (depth > 0).astype(np.float32)
    return View(np.zeros((*depth.shape, 3), np.float32), depth.astype(np.float32), shown)


def along_x(z_m: float = 0.0, x_m: float = 0.0) -> Camera:
    rows = [[0.0, 0.0, 1.0, x_m], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, z_m]]
    return Camera(Intrinsics(64, 48, 40.0, 40.0, 32.0, 24.0), Pose.from_matrix(rows))


class Views:
    """Renders level ground and counts; the first view is through fog that shortens its depths."""

    def __init__(self, fog: float) -> None:
        self.renders = 0
        self._fog = fog

    def render(self, camera: Camera) -> View:
        self.renders += 1
        return level_ground(camera, shorter=self._fog if self.renders == 1 else 0.0)


def plane_of(ground: FieldGround, camera: Camera) -> GroundPlane:
    plane = ground.ahead_of(camera)
    assert plane is not None
    return plane


@pytest.mark.parametrize("slope", [0.0, 0.04, -0.04])
def test_the_plane_is_that_of_the_ground(slope: float) -> None:
    """Where views begin is as high as the camera, so that a slope puts them nearer to the ground
    or further from it; points about the middle of a view lean by the pull towards level ground."""
    ground = FieldGround(lambda camera: level_ground(camera, slope=slope))
    plane = plane_of(ground, along_x())
    at_m = np.array([[0.0, 0.0], [10.0, 1.0], [20.0, -1.0]])
    np.testing.assert_allclose(
        plane.heights_m(at_m), -CAMERA_M + slope * at_m[:, 0], atol=0.02 + abs(slope)
    )
    assert plane.slopes == (pytest.approx(slope, abs=0.004), pytest.approx(0.0, abs=0.004))


def test_one_view_through_fog_moves_it_little() -> None:
    """A tenth off its depths lifts a single view by 0.15 m."""
    plane = plane_of(FieldGround(Views(0.1).render), along_x())
    assert plane.height_m == pytest.approx(-CAMERA_M, abs=0.03)
    assert plane.slopes[0] == pytest.approx(0.0, abs=0.01)


def test_what_floats_above_half_of_it_does_not_raise_it() -> None:
    """They float up to a fifth of the depth, 0.3 m; the median lies 0.03 m above the ground."""
    rng = np.random.default_rng(4)

    def floating(camera: Camera) -> View:
        view = level_ground(camera)
        shorter = np.where(rng.random(view.depth.shape) < 0.6, rng.uniform(0, 0.2), 0.0)
        return replace(view, depth=(view.depth * (1 - shorter)).astype(np.float32))

    plane = plane_of(FieldGround(floating), along_x())
    assert plane.height_m == pytest.approx(-CAMERA_M, abs=0.02)


def test_each_place_is_drawn_once() -> None:
    views = Views(0.0)
    ground = FieldGround(views.render)
    first = plane_of(ground, along_x())
    drawn = views.renders
    assert plane_of(ground, along_x()) == first
    assert views.renders == drawn
    plane_of(ground, along_x(x_m=4.0))
    assert views.renders == drawn + 1


def test_a_place_that_was_drawn_to_warm_up_is_not_drawn_again() -> None:
    views = Views(0.0)
    ground = FieldGround(views.render)
    ground.warm_up((0.0, 0.0, 0.0))
    assert views.renders == 1
    plane_of(ground, along_x())
    assert views.renders == STEPS


def test_a_field_without_ground_has_none() -> None:
    def nothing(camera: Camera) -> View:
        shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        flat = np.zeros(shape, np.float32)
        return View(np.zeros((*shape, 3), np.float32), flat, flat)

    assert FieldGround(nothing).ahead_of(along_x()) is None


def test_the_street_of_splats_has_its_ground() -> None:
    plane = plane_of(FieldGround(FIELD.render), camera_at())
    at_m = np.array([[0.0, 4.0], [-3.0, 8.0], [3.0, 12.0]])
    np.testing.assert_allclose(plane.heights_m(at_m), -CAMERA_M, atol=0.1)


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_a_ray_meets_the_plane_where_algebra_says(slope: float) -> None:
    """Points of level or sloping ground, looked at again."""
    camera = camera_at(1.0, 0.1)
    rays = rays_of(camera, ROWS, COLUMNS)
    plane = GroundPlane((0.0, 0.0), -CAMERA_M, (0.0, slope))
    eye_m = camera.world_from_cam.translation_m
    depths_m = plane.depths_m(eye_m, rays)
    points_m = points_of(camera, ROWS, COLUMNS, depths_m)
    np.testing.assert_allclose(points_m[:, 2], -CAMERA_M + slope * points_m[:, 1], atol=1e-9)


def test_a_ray_that_does_not_fall_meets_none() -> None:
    plane = GroundPlane((0.0, 0.0), -CAMERA_M, (0.0, 0.0))
    rays = rays_of(camera_at(), np.array([10, 79], np.intp), np.array([160, 160], np.intp))
    assert (plane.depths_m((0.0, 0.0, 0.0), rays) == math.inf).all()
