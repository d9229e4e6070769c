"""Rendered frames show what stands there, where it stands, by every variant of the renderer."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from streetgen.classes import Label
from streetgen.geometry.solids import Surface, boxes
from streetgen.geometry.world import Mover, Sky, World
from streetgen.render.backend import PROBE, Backend, chosen_backend
from streetgen.render.mitsuba_scene import with_sun
from streetgen.render.renderer import PathTracer, Sampling
from streetgen.trajectory import looking

SCALAR = Backend("scalar_rgb")


def camera(width_px: int = 64, height_px: int = 36, yaw_rad: float = 0.0) -> Camera:
    k = Intrinsics(width_px, height_px, width_px / 2, width_px / 2, width_px / 2, height_px / 2)
    return Camera(k, looking(np.array([0.0, 0.0, 1.0]), yaw_rad, 0.0))


@pytest.fixture(scope="module")
def fastest() -> Backend:
    return chosen_backend()


@pytest.fixture(scope="module")
def renderer(yard: World, fastest: Backend) -> PathTracer:
    return PathTracer(yard, Sampling(16), fastest, 1)


def test_a_known_point_lands_on_its_pixel_at_its_depth(renderer):
    """Depths of the floor, the box and the wall by algebra, at every pixel."""
    seen_by = camera()
    view = renderer.render(seen_by)
    u, v, _ = seen_by.project((4.0, 1.5, 0.75))
    assert view.labels[int(v), int(u)] == Label.VEHICLE
    assert view.depth_m[int(v), int(u)] == pytest.approx(4.0, abs=1e-4)
    below = view.labels == Label.ROAD
    rows = np.nonzero(below)[0]
    np.testing.assert_allclose(view.depth_m[below], 32 / (rows + 0.5 - 18), rtol=1e-4)
    np.testing.assert_allclose(view.depth_m[view.labels == Label.BUILDING], 10.0, atol=1e-4)
    assert np.isinf(view.depth_m[view.labels == Label.SKY]).all()
    assert set(np.unique(view.labels)) == {0, Label.ROAD, Label.BUILDING, Label.VEHICLE}


def test_unprojected_pixels_lie_on_the_surfaces_they_show(renderer):
    seen_by = camera(yaw_rad=0.3)
    view = renderer.render(seen_by)
    k = seen_by.intrinsics
    rows, columns = np.nonzero(view.labels == Label.ROAD)
    z = view.depth_m[rows, columns]
    x, y = (columns + 0.5 - k.cx_px) / k.fx_px * z, (rows + 0.5 - k.cy_px) / k.fy_px * z
    up = np.array([seen_by.world_from_cam.apply(p)[2] for p in zip(x, y, z, strict=True)])
    np.testing.assert_allclose(up, 0.0, atol=1e-3)


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(yard, renderer, fastest):
    first, later = renderer.render(camera()), renderer.render(camera(), time_s=3.0)
    two_threads = PathTracer(yard, Sampling(16), fastest, 2).render(camera())
    other_seed = PathTracer(yard, Sampling(16, seed=2), fastest, 2).render(camera())
    assert first.colour.tobytes() == later.colour.tobytes()
    assert first.colour.tobytes() == two_threads.colour.tobytes()
    assert first.colour.tobytes() != other_seed.colour.tobytes()
    assert np.isfinite(first.colour).all()
    assert first.colour.min() >= 0


def test_the_scalar_variant_shows_the_same(yard, renderer):
    """The samples differ, so colours agree only to their noise; geometry agrees to rounding."""
    small = camera(32, 18)
    one, other = renderer.render(small), PathTracer(yard, Sampling(16), SCALAR, 1).render(small)
    np.testing.assert_array_equal(one.labels, other.labels)
    np.testing.assert_allclose(one.depth_m, other.depth_m, rtol=1e-5)
    assert abs(one.colour - other.colour).mean() < 0.03 * one.colour.mean()


def test_a_floor_in_the_sun_is_as_bright_as_radiometry_says(renderer):
    """Reflectance / pi times irradiance: of the sun's disc, and of a uniform dome, pi L."""
    view = renderer.render(camera())
    half_angle = np.radians(0.53 / 2)
    sun = 6e4 * np.pi * np.sin(half_angle) ** 2 * 0.8
    irradiance = sun + np.pi * 0.4
    levels = np.array([60, 180]) / 255
    reflectance = (((levels + 0.055) / 1.055) ** 2.4).mean()
    open_floor = view.colour[24:, :20][view.labels[24:, :20] == Label.ROAD]
    assert open_floor.mean() == pytest.approx(reflectance / np.pi * irradiance, rel=0.12)


def test_what_moves_is_where_it_is_at_that_time(yard, fastest):
    def along_y(time_s: float) -> np.ndarray:
        matrix = np.eye(4)
        matrix[1, 3] = -2.0 * time_s
        return matrix

    ball = boxes(Surface("lacquer", Label.OBJECT), (3, 0.0, 0.8), (3.4, 0.4, 1.2))
    moving = PathTracer(replace(yard, movers=(Mover((ball,), along_y),)), Sampling(4), fastest, 1)
    middles = []
    for time_s in (0.0, 0.5, 0.0):
        labels = moving.render(camera(), time_s).labels
        middles.append(np.nonzero(labels == Label.OBJECT)[1].mean() + 0.5)
    assert middles[0] == middles[2]
    assert middles[1] - middles[0] == pytest.approx(32 * 1.0 / 3.0, abs=1.0)


def test_the_probes_program_renders():
    subprocess.run([sys.executable, "-c", PROBE, "scalar_rgb"], check=True)


@pytest.mark.parametrize("diameter_deg", [0.1, 0.53, 5.0])
def test_the_painted_sun_gives_the_light_of_its_disc(diameter_deg):
    sky = Sky(np.zeros((64, 128, 3), np.float32), (0.6, 0.0, 0.8), (100.0,) * 3, diameter_deg)
    painted = with_sun(sky)
    rows = (np.arange(len(painted)) + 0.5) / len(painted) * np.pi
    solid_angle = np.sin(rows)[:, None] * (np.pi / len(painted)) ** 2
    light = float((painted[..., 0] * solid_angle).sum())
    expected = 100 * 2 * np.pi * (1 - np.cos(np.radians(diameter_deg) / 2))
    assert light == pytest.approx(expected, rel=1e-3)
    row, column = np.unravel_index(painted[..., 0].argmax(), painted.shape[:2])
    assert abs(rows[row] - np.arccos(0.8)) < 0.05
    assert min(column, painted.shape[1] - column) < 20, "azimuth 0 is column 0"


@pytest.mark.parametrize("samples", [0, 15, 5000])
def test_samples_that_are_no_square_are_refused(samples):
    with pytest.raises(InvalidInput, match="not a square number"):
        Sampling(samples)


def test_a_camera_off_its_middle_is_refused(renderer):
    k = replace(camera().intrinsics, cx_px=30.0)
    with pytest.raises(InvalidInput, match="about the middle"):
        renderer.render(Camera(k, Pose.identity()))
