"""Rolling shutters against a render for each line, and what their bands promise."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import SplatField
from rfcore.lens import BrownLens
from rfcore.metrics import psnr
from rfcore.native.backend import available_isas
from rfedge.twin.lens_picture import LensModel, RadialLens, render_through
from rfedge.twin.placed_objects import PlacedObject, with_objects
from rfedge.twin.shutter import (
    MOST_PX,
    Motion,
    MovingBox,
    Shutter,
    bands,
    lines_motion_px,
    render_rolling,
)
from wall_scene import WALL_M

K = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
STILL = Motion(Pose.identity(), Pose.identity())
SWEEP = Motion(
    Pose((-0.15, 0.05, 0.0), (math.cos(0.01), 0.0, math.sin(0.01), 0.0)),
    Pose((0.15, -0.05, 0.3), (math.cos(0.05), 0.0, math.sin(0.05), 0.0)),
)
"""14 pixels to the side, without a turn at which the order of the wall's splats would change."""
SHUTTERS = [Shutter(columns, reverse) for columns in (False, True) for reverse in (False, True)]
FISHEYE = RadialLens((0.0, 1.0, 0.0, 0.02), max_angle_rad=0.5)


@pytest.fixture(scope="module")
def wall(wall: SplatField) -> SplatField:
    """The wall in checks of two colours, which pictures that are a pixel off do not share."""
    x, y = wall.gaussians.means[:, 0], wall.gaussians.means[:, 1]
    level = np.sign(np.sin(6 * x) * np.sin(6 * y)).astype(np.float32)
    return SplatField(replace(wall.gaussians, sh=np.repeat(level, 3).reshape(-1, 1, 3)))


def rolled(field: SplatField, model: LensModel, motion: Motion, shutter: Shutter) -> np.ndarray:
    moves = lines_motion_px(field, model, motion, shutter)
    return render_rolling(lambda _: field, model, motion, shutter, moves)


def line_by_line(field: SplatField, model: LensModel, motion: Motion, shutter: Shutter):
    """The oracle: a whole render at the instant of each line."""
    k = model.intrinsics
    lines = k.width_px if shutter.columns else k.height_px
    order = range(lines - 1, -1, -1) if shutter.reverse else range(lines)
    picture = np.empty((k.height_px, k.width_px, 3), np.uint8)
    for count, line in enumerate(order):
        whole = render_through(field, model, motion.at(count / (lines - 1)))
        part = (slice(None), line) if shutter.columns else line
        picture[part] = whole[part]
    return picture


@pytest.mark.parametrize(
    ("shutter", "lens"),
    [
        *((shutter, None) for shutter in SHUTTERS),
        (SHUTTERS[0], BrownLens(-0.1, k4=0.05)),
        (SHUTTERS[3], FISHEYE),
    ],
)
def test_every_line_is_seen_at_its_own_instant(wall, shutter, lens):
    """Less is lost than by half a pixel; the middle of the exposure loses more than by one."""
    model = LensModel(K, lens)
    truth = line_by_line(wall, model, SWEEP, shutter)
    middle = render_through(wall, model, SWEEP.middle)

    def shifted_db(px: float) -> float:
        moved = LensModel(replace(K, cx_px=K.cx_px + px), lens)
        return psnr(render_through(wall, moved, SWEEP.middle), middle)

    shown = rolled(wall, model, SWEEP, shutter)
    assert psnr(shown, truth) > shifted_db(MOST_PX / 2) > 20
    assert psnr(middle, truth) < shifted_db(MOST_PX)
    if lens is FISHEYE:
        np.testing.assert_array_equal(shown.any(axis=2), truth.any(axis=2))


@pytest.mark.parametrize("shutter", SHUTTERS)
def test_no_pixel_is_half_a_pixel_from_where_its_line_has_it(wall, shutter):
    """By algebra: the wall's point at each pixel, seen from the pose of the pixel's band."""
    moves = lines_motion_px(wall, LensModel(K), SWEEP, shutter)
    made = list(bands(moves))
    assert 10 < len(made) < 25
    worst_px = 0.0
    for first, end in made:
        band = Camera(K, SWEEP.at(shutter.instant((first + end - 1) / 2, len(moves))))
        for line in range(first, end):
            pose = SWEEP.at(shutter.instant(line, len(moves)))
            for other in (0.5, 24.5, 47.5):
                u, v = (line + 0.5, other) if shutter.columns else (other, line + 0.5)
                ray = pose.apply(((u - K.cx_px) / K.fx_px, (v - K.cy_px) / K.fy_px, 1.0))
                eye = pose.translation_m
                far = (WALL_M - eye[2]) / (ray[2] - eye[2])
                point = [e + far * (r - e) for e, r in zip(eye, ray, strict=True)]
                there = band.project(point)
                worst_px = max(worst_px, math.hypot(there[0] - u, there[1] - v))
    assert 0.2 < worst_px <= MOST_PX / 2 * 1.05  # depth is a mean of splats, near the wall's


@given(st.lists(st.floats(0, 500), min_size=1, max_size=60))
def test_bands_hold_every_line_once_and_move_by_no_more_than_is_allowed(moves):
    made = list(bands(np.array(moves)))
    assert [line for first, end in made for line in range(first, end)] == list(range(len(moves)))
    for first, end in made:
        assert (end - 1 - first) * max(moves[first:end]) <= MOST_PX * max(len(moves) - 1, 0)


def test_a_picture_that_does_not_move_is_one_band(wall):
    moves = lines_motion_px(wall, LensModel(K), STILL, Shutter())
    assert list(bands(moves)) == [(0, K.height_px)]


@given(st.floats(0, 1), st.floats(0.01, 1.5))
def test_poses_between_turn_evenly_and_move_straight(share, half_angle):
    motion = Motion(
        Pose.identity(), Pose((2.0, 0.0, 4.0), (-math.cos(half_angle), 0, 0, -math.sin(half_angle)))
    )
    pose = motion.at(share)
    assert pose.translation_m == pytest.approx((2 * share, 0.0, 4 * share), abs=1e-6)
    turned = half_angle * share
    assert abs(pose.rotation[0]) == pytest.approx(math.cos(turned), abs=1e-6)
    assert abs(pose.rotation[3]) == pytest.approx(math.sin(turned), abs=1e-6)
    assert (motion.at(0), motion.at(1)) == (motion.start, motion.end)


def test_what_comes_near_moves_more_and_what_lies_behind_moves_nothing(wall):
    model, shutter = LensModel(K), Shutter()

    def moves(z_m: float, motion: Motion = SWEEP) -> np.ndarray:
        box = replace(wall.bounds, low_m=(-0.1, -0.1, z_m), high_m=(0.1, 0.1, z_m + 0.1))
        return lines_motion_px(wall, model, motion, shutter, [MovingBox(box, STILL)])

    street = lines_motion_px(wall, model, SWEEP, shutter)
    np.testing.assert_array_equal(moves(-3.0), street)
    near = moves(1.0)
    assert near[24] > street[24] + 10
    assert near[0] == street[0], "above the object"
    assert (moves(0.2) >= K.width_px).all(), "the camera passes it: a render for each row"


@pytest.fixture(scope="module")
def ball(wall: SplatField) -> SplatField:
    """A white ball of 0.2 m, one splat for each of 300 places."""
    means = np.random.default_rng(5).normal(size=(300, 3)).astype(np.float32)
    means *= np.float32(0.2) / np.linalg.norm(means, axis=1, keepdims=True)
    one = {name: np.ascontiguousarray(value[:300]) for name, value in vars(wall.gaussians).items()}
    white = np.full((300, 1, 3), 1.77, np.float32)
    small = np.full((300, 3), np.log(0.03), np.float32)
    return SplatField(
        replace(wall.gaussians, **one | {"means": means, "sh": white, "log_scales": small})
    )


def test_an_object_that_moves_leans_as_a_render_for_each_row_has_it(wall, ball):
    """The camera is still; the ball crosses 18 pixels."""
    model, shutter = LensModel(K), Shutter()
    motion = Motion(Pose((-0.3, 0.0, 2.0), (1, 0, 0, 0)), Pose((0.3, 0.0, 2.0), (1, 0, 0, 0)))

    def field_at(share: float) -> SplatField:
        return with_objects(wall, [PlacedObject(ball, motion.at(share))])

    moves = lines_motion_px(wall, model, STILL, shutter, [MovingBox(ball.bounds, motion)])
    shown = render_rolling(field_at, model, STILL, shutter, moves)
    truth = np.stack(
        [render_through(field_at(row / 47), model, STILL.start)[row] for row in range(48)]
    )
    assert psnr(shown, truth) > 30
    assert psnr(render_through(field_at(0.5), model, STILL.start), truth) < 28
    beside = np.abs(np.arange(48) - 24) > 11
    wall_alone = render_through(wall, model, STILL.start)
    np.testing.assert_allclose(shown[beside].astype(int), wall_alone[beside], atol=3)


def test_the_bytes_are_the_same_on_every_instruction_set_and_number_of_threads(wall, ball):
    turned = Pose((0.1, 0.0, 2.0), (0.8, 0.0, 0.6, 0.0))
    motion = Motion(turned, replace(turned, translation_m=(0.2, 0.1, 2.0)))
    models = [
        LensModel(K),
        LensModel(K, BrownLens(-0.05, k4=0.02, s1=0.001)),
        LensModel(K, FISHEYE),
    ]

    def pictures(field: SplatField) -> list[bytes]:
        def field_at(share: float) -> SplatField:
            return with_objects(field, [PlacedObject(ball, motion.at(share))])

        box = MovingBox(ball.bounds, motion)
        made = []
        for model in models:
            moves = lines_motion_px(field, model, SWEEP, Shutter(), [box])
            made.append(render_rolling(field_at, model, SWEEP, Shutter(), moves).tobytes())
        return made

    first = pictures(wall)
    for isa, threads in [*((isa, 1) for isa in available_isas()), (None, 3)]:
        assert pictures(SplatField(wall.gaussians, threads=threads, isa=isa)) == first, isa
