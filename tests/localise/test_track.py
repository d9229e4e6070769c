"""Laws of tracking: a motion moves pixels, and wrong depth limits the camera's motion."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from localise.planes import INTRINSICS, WALL_M, Planes, picture
from rfcore.camera import Camera, Pose
from rfcore.field import FULL, Quality, Renderer, render_field_view
from rfcore.localise.alignment import Template
from rfcore.localise.matching import Pyramid
from rfcore.localise.track import (
    RenderAt,
    Track,
    TrackingBudget,
    begin_track,
    follow_track,
)
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import View

TEMPLATE = Template.of(render_field_view(Planes(), Camera(INTRINSICS, Pose.identity())))
METRES = st.floats(-0.3, 0.3)
RADIANS = st.floats(-0.02, 0.02)


def projected_px(motion: Pose, level: int) -> float:
    """Return by how much a motion moves the projections of a level's points (OpenCV)."""
    k, points = INTRINSICS, TEMPLATE.level(level).points.T.astype(np.float64)
    matrix = np.array([[k.fx_px, 0, k.cx_px], [0, k.fy_px, k.cy_px], [0, 0, 1]])
    turn, shift = np.array(rotation_vector(motion.rotation)), np.array(motion.translation_m)
    before, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)
    after, _ = cv2.projectPoints(points, turn, shift, matrix, None)
    return math.sqrt(float(((after - before) ** 2).sum(axis=(1, 2)).mean()))


@given(METRES, METRES, METRES, RADIANS, RADIANS, RADIANS, st.integers(0, 2))
def test_a_motion_moves_pixels_as_far_as_opencv_projects_them(x, y, z, a, b, c, level):
    motion = Pose((x, y, z), quaternion_from_vector((a, b, c)))
    expected_px = pytest.approx(projected_px(motion, level), rel=1e-3, abs=1e-3)
    assert TEMPLATE.moved_px(motion, level) == expected_px


def test_what_a_turn_undoes_far_away_still_moves_what_is_near():
    down_m = 0.19
    turn = quaternion_from_vector((down_m / WALL_M, 0.0, 0.0))
    at_the_wall = Pose((0.0, down_m, 0.0), turn)
    assert TEMPLATE.moved_px(at_the_wall) > 1.0
    assert TEMPLATE.moved_px(Pose.identity()) == 0.0


class Shallow:
    """The street of planes with depths that are 5 % too small, as a trained field's may be."""

    def __init__(self, share: float) -> None:
        self.share = share

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        shown = Planes().render(camera, quality)
        return replace(shown, depth=shown.depth * np.float32(self.share))


def ahead(metres: float) -> Pose:
    return Pose((0.0, 0.0, metres), (1.0, 0.0, 0.0, 0.0))


def drawn_by(renderer: Renderer) -> RenderAt:
    return lambda pose: render_field_view(renderer, Camera(INTRINSICS, pose).rounded())


def begun_at(pose: Pose, renderer: Renderer) -> Track:
    """Return the track that begins with the picture taken at a pose."""
    track = begin_track(0, pose, None, Pyramid(picture(pose).y), drawn_by(renderer))
    assert track is not None
    return track


def followed_to(pose: Pose, number: int, track: Track, renderer: Renderer) -> Track:
    """Return the track with the picture taken at a pose, the one of that number at 10 Hz."""
    levels, time_ns = Pyramid(picture(pose).y), number * 10**8
    further = follow_track(track, time_ns, levels, drawn_by(renderer), TrackingBudget(1))
    assert further is not None
    return further


@pytest.mark.parametrize(("share", "scale"), [(1.0, 1.0), (0.95, 1 / 0.95)])
def test_motions_are_scaled_by_what_the_depth_is_wrong(share, scale):
    """Depth of a share makes movements look like that share of what they are."""
    shallow = Shallow(share)
    track = begun_at(ahead(0.0), shallow)
    for number in range(1, 10):
        track = followed_to(ahead(0.4 * number), number, track, shallow)
    assert track.motion_scale == pytest.approx(scale, abs=0.012)


def test_tracking_from_half_the_resolution_on_leaves_the_finest_level_out():
    """The finest structure, which is most of the time, is never made; poses stay near."""

    def at(number: int) -> Pose:
        return Pose((0.02 * number, 0.0, 0.1 * number), (1.0, 0.0, 0.0, 0.0))

    half = TrackingBudget(0, finest=1)
    track = begun_at(at(0), Planes())
    for number in range(1, 6):
        levels = Pyramid(picture(at(number)).y)
        further = follow_track(track, number * 10**8, levels, drawn_by(Planes()), half)
        assert further is not None
        track = further
        assert track.renders == 1
        assert 0 not in levels.made | track.template.structures.made
        assert math.dist(track.world_from_cam.translation_m, at(number).translation_m) < 0.02


@pytest.mark.parametrize(("step_m", "share"), [(0.8, 0.7), (0.8, 1.25), (1.2, 0.8), (1.2, 1.25)])
def test_a_picture_that_was_predicted_far_off_is_found_with_one_render_more(step_m, share):
    """Wrong depth leads it 0.1 m and more aside, further than the finest level reaches."""
    track = begun_at(ahead(0.0), Planes())
    for number in (1, 2):
        track = followed_to(ahead(step_m * number), number, track, Planes())
    wrong = replace(track.view, depth=track.view.depth * np.float32(share))
    track = replace(track, view=wrong, template=Template.of(wrong))
    track = followed_to(ahead(step_m * 3), 3, track, Planes())
    assert track.renders == 2
    sent = track.view.camera.world_from_cam
    assert math.dist(sent.translation_m, ahead(step_m * 3).translation_m) < 0.01
