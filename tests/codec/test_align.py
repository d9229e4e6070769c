"""A pose off by centimetres is found again: on a street of planes whose truth is known."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.sender.align import align
from rfcore.codec.sender.pose_search import PoseSearch
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

INTRINSICS = Intrinsics(320, 192, 200.0, 200.0, 160.0, 96.0)
TRUTH = Camera(INTRINSICS, Pose((1.0, -0.5, 2.0), (1.0, 0.0, 0.0, 0.0)))
GROUND_M, WALL_M = 1.5, 12.0


def texture(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Waves no shorter than 0.7 m, which 12 m away are 12 px, in two directions of a plane."""
    waves = np.sin(2.1 * a + 0.5) * np.cos(1.7 * b) + 0.7 * np.sin(5.3 * a - 3.1 * b)
    return waves + 0.5 * np.sin(8.9 * b + 1.3 * a)


def render_at(camera: Camera) -> FieldView:
    """Ray-trace a textured ground 1.5 m below the origin and a wall 12 m before it."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
    rays = np.stack([(x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px, np.ones_like(x)], -1)
    world = rays @ np.array(camera.world_from_cam.rotation_matrix()).T
    ox, oy, oz = camera.world_from_cam.translation_m
    with np.errstate(divide="ignore"):
        to_ground = np.where(world[..., 1] > 1e-9, (GROUND_M - oy) / world[..., 1], np.inf)
    to_wall = (WALL_M - oz) / world[..., 2]
    depth = np.minimum(to_ground, to_wall)
    px, py, pz = (o + depth * world[..., i] for i, o in enumerate((ox, oy, oz)))
    pattern = np.where(to_ground < to_wall, texture(px, pz), texture(px, py) + 0.3)
    luma = np.clip(np.rint(120 + 35 * pattern), 1, 255).astype(np.uint8)
    half = np.full((k.height_px // 2, k.width_px // 2), 128, np.uint8)
    opacity = np.ones(depth.shape, np.float32)
    return FieldView(camera, I420(luma, half, half), depth.astype(np.float32), opacity)


FRAME = render_at(TRUTH).render


def off_by(metres: float, degrees: float, seed: int) -> Camera:
    """Return the true camera, moved and turned by so much in a direction of chance."""
    rng = np.random.default_rng(seed)
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    shift *= metres / np.linalg.norm(shift)
    turn *= math.radians(degrees) / 2 / np.linalg.norm(turn)
    rotation = (math.sqrt(1 - float(turn @ turn)), *map(float, turn))
    error = Pose((float(shift[0]), float(shift[1]), float(shift[2])), rotation)
    return replace(TRUTH, world_from_cam=TRUTH.world_from_cam.compose(error).rounded())


def distance(found: Camera) -> tuple[float, float]:
    motion = TRUTH.world_from_cam.inverse().compose(found.world_from_cam)
    sine = math.sqrt(sum(v * v for v in motion.rotation[1:]))
    return math.hypot(*motion.translation_m), math.degrees(2 * math.asin(min(1.0, sine)))


def clock_of(step_ns: int) -> Callable[[], int]:
    """Return a clock that goes on by ``step_ns`` each time it is read."""
    return itertools.count(0, step_ns).__next__


@settings(max_examples=15, deadline=None)
@given(metres=st.floats(0, 0.2), degrees=st.floats(0, 0.5), seed=st.integers(0, 1000))
def test_a_pose_off_by_up_to_20_cm_and_half_a_degree_is_found(
    metres: float, degrees: float, seed: int
) -> None:
    """To 1/4 px: a 320 px picture of f = 200 px sees 0.07 degrees, or 15 mm at 12 m, so."""
    refined = PoseSearch(1e3, clock_of(0)).refine(
        FRAME, render_at(off_by(metres, degrees, seed)), render_at, 23
    )
    left_m, left_degrees = distance(refined.view.camera)
    assert left_m < 0.015
    assert left_degrees < 0.07


def test_a_true_pose_stays() -> None:
    refined = PoseSearch(1e3, clock_of(0)).refine(FRAME, render_at(TRUTH), render_at, 23)
    assert distance(refined.view.camera)[0] < 0.001


def test_another_light_and_a_car_do_not_move_it() -> None:
    measured = render_at(off_by(0.1, 0.1, 3))
    luma = np.rint(0.7 * FRAME.y + 20).astype(np.uint8)
    luma[100:160, 60:140] = 220
    motion = align(I420(luma, FRAME.u, FRAME.v), measured)
    camera = measured.camera
    found = replace(camera, world_from_cam=camera.world_from_cam.compose(motion.inverse()))
    left_m, left_degrees = distance(found)
    assert left_m < 0.02
    assert left_degrees < 0.05


@pytest.mark.parametrize("level", [1, 128, 255])
def test_a_picture_that_says_nothing_moves_nothing(level: int) -> None:
    flat = I420(np.full_like(FRAME.y, level), FRAME.u, FRAME.v)
    measured = render_at(TRUTH)
    assert align(FRAME, replace(measured, render=flat)) == Pose.identity()
    moved = math.hypot(*align(flat, measured).translation_m)
    assert moved < 0.05


def test_depth_of_nothing_moves_nothing() -> None:
    measured = render_at(off_by(0.1, 0.1, 3))
    nothing = np.zeros_like(measured.depth)
    assert align(FRAME, replace(measured, depth=nothing)) == Pose.identity()


@pytest.mark.parametrize("size_px", [(2, 2), (3, 61), (130, 7)])
def test_pictures_of_a_few_pixels_stay_where_they_are(size_px: tuple[int, int]) -> None:
    width, height = size_px
    camera = replace(TRUTH, intrinsics=Intrinsics(width, height, 50, 50, width / 2, height / 2))
    half = np.full(((height + 1) // 2, (width + 1) // 2), 128, np.uint8)
    noise = np.random.default_rng(1).integers(1, 255, (height, width), dtype=np.uint8)
    picture = I420(noise, half, half)
    depth = np.full((height, width), 5, np.float32)
    moved = align(picture, FieldView(camera, picture, depth, np.ones_like(depth)))
    assert math.hypot(*moved.translation_m) < 1e-6


def test_a_noise_frame_is_not_believed() -> None:
    noise = np.random.default_rng(1).integers(1, 255, FRAME.y.shape, dtype=np.uint8)
    measured = render_at(TRUTH)
    refined = PoseSearch(1e3, clock_of(0)).refine(
        I420(noise, FRAME.u, FRAME.v), measured, render_at, 23
    )
    assert refined.view is measured
    assert (refined.moved_m, refined.turned_rad) == (0.0, 0.0)


def test_out_of_time_the_measured_pose_is_taken() -> None:
    measured = render_at(off_by(0.1, 0.1, 3))
    rendered = []

    def note_and_render(camera: Camera) -> FieldView:
        rendered.append(camera)
        return render_at(camera)

    refined = PoseSearch(1.0, clock_of(2_000_000)).refine(FRAME, measured, note_and_render, 23)
    assert refined.view is measured
    assert not rendered


def test_a_longer_search_is_never_worse() -> None:
    measured = render_at(off_by(0.2, 0.4, 5))
    left = []
    for budget_ms in (2, 20, 2000):
        refined = PoseSearch(budget_ms, clock_of(1_000_000)).refine(FRAME, measured, render_at, 23)
        left.append(distance(refined.view.camera)[0])
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.01 < left[0]


@pytest.mark.parametrize("budget_ms", [0.0, -1.0, float("nan")])
def test_a_budget_that_is_none_is_refused(budget_ms: float) -> None:
    with pytest.raises(InvalidInput, match="refine_pose_ms"):
        PoseSearch(budget_ms, clock_of(0))
