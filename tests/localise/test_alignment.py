"""A render is brought to agree with a picture: on a street of planes whose truth is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localise.planes import INTRINSICS, Planes, picture
from rfcore.camera import Camera, Pose
from rfcore.field import render_field_view
from rfcore.image import I420
from rfcore.localise.agreement import agreement_on_track
from rfcore.localise.alignment import Aligned, Expected, Template, align
from rfcore.localise.estimate import moved
from rfcore.localise.matching import Pyramid
from rfcore.motion import rotation_vector
from rfcore.views import FieldView

TRUTH = Pose((1.0, -0.5, 2.0), (1.0, 0.0, 0.0, 0.0))
EXPECTED = Expected(0.2, math.radians(0.5))


def view_at(pose: Pose) -> FieldView:
    return render_field_view(Planes(), Camera(INTRINSICS, pose))


def off_by(metres: float, degrees: float, seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    shift, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    x, y, z = (metres * shift).tolist()
    a, b, c = (math.radians(degrees) * turn).tolist()
    return moved(TRUTH, (x, y, z), (a, b, c))


def error_of(found: Pose) -> tuple[float, float]:
    between = TRUTH.inverse().compose(found)
    turned = math.degrees(math.hypot(*rotation_vector(between.rotation)))
    return math.hypot(*between.translation_m), turned


def aligned(drawn_at: Pose, start: Pose, frame: I420 | None = None) -> Aligned | None:
    frame = picture(TRUTH) if frame is None else frame
    return align(Template.of(view_at(drawn_at)), Pyramid(frame.y), start, EXPECTED)


@settings(max_examples=12, deadline=None)
@given(metres=st.floats(0, 0.2), degrees=st.floats(0, 0.5), seed=st.integers(0, 1000))
def test_a_pose_off_by_up_to_20_cm_and_half_a_degree_is_found(metres, degrees, seed):
    """To a few hundredths of a pixel of 200 px a radian: 14 m away, 0.05 px are 3.5 mm."""
    there = off_by(metres, degrees, seed)
    found = aligned(there, Pose.identity())
    metres_left, degrees_left = error_of(there.compose(found.motion.inverse()))
    assert metres_left < 0.01
    assert degrees_left < 0.03


def test_the_render_of_an_earlier_frame_serves_when_the_motion_is_about_known():
    before = moved(TRUTH, (0.05, 0.0, -0.8), (0.0, 0.01, 0.0))
    guess = off_by(0.15, 0.3, 5).inverse().compose(before)
    found = aligned(before, guess)
    metres_left, degrees_left = error_of(before.compose(found.motion.inverse()))
    assert metres_left < 0.015
    assert degrees_left < 0.04


def test_a_change_of_light_moves_nothing():
    frame = picture(TRUTH)
    darker = I420((frame.y // 3 + 20).astype(np.uint8), frame.u, frame.v)
    found = aligned(TRUTH, Pose.identity(), darker)
    assert error_of(TRUTH.compose(found.motion.inverse()))[0] < 0.01


def test_a_large_object_that_moves_does_not_take_the_pose_along():
    """A third of the picture is another texture, displaced from where it was."""
    frame = picture(TRUTH)
    other = picture(Pose((30.0, -0.5, 5.0), TRUTH.rotation)).y
    y = frame.y.copy()
    y[:, :100] = other[:, 60:160]
    there = off_by(0.08, 0.2, 2)
    found = aligned(there, Pose.identity(), I420(y, frame.u, frame.v))
    assert error_of(there.compose(found.motion.inverse()))[0] < 0.02


def test_a_picture_without_texture_moves_nothing():
    frame = picture(TRUTH)
    found = aligned(TRUTH, Pose.identity(), I420(np.full_like(frame.y, 90), frame.u, frame.v))
    assert found is None or error_of(TRUTH.compose(found.motion.inverse()))[0] < 0.2


@pytest.mark.parametrize(
    ("metres", "degrees", "agrees"),
    [(0.0, 0.0, True), (0.02, 0.05, True), (0.5, 5.0, False), (5.0, 0.0, False)],
)
def test_only_the_right_pose_agrees(metres, degrees, agrees):
    view = view_at(off_by(metres, degrees, 3))
    seen, drawn = Pyramid(picture(TRUTH).y)[1], Pyramid(view.render.y)[1]
    assert (agreement_on_track(seen, drawn, view) > 15) == agrees
