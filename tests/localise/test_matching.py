"""Matches become a pose: exactly where the answer is known by algebra, and none without cause."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.localise.estimate import moved
from rfcore.localise.matching import (
    Features,
    Matches,
    find_features,
    lift_matches,
    match_features,
    solve_pose,
)
from rfcore.views import View

INTRINSICS = Intrinsics(160, 120, 100.0, 90.0, 82.0, 57.0)
DRAWN_AT = Pose((5.0, 6.0, 7.0), (0.5, -0.5, 0.5, -0.5))
TRUTH = moved(DRAWN_AT, (0.4, -0.1, 0.7), (0.02, 0.1, -0.01))


def exact_matches(count: int) -> Matches:
    """Points ahead of the render's camera, and where a camera at TRUTH sees them."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, -2, 6], [3, 2, 14], (count, 3))
    camera = Camera(INTRINSICS, TRUTH)
    places = [camera.project(DRAWN_AT.apply(point))[:2] for point in points.tolist()]
    return Matches(np.array(places) - 0.5, points)


def test_exact_matches_give_the_exact_pose():
    found = solve_pose(exact_matches(40), INTRINSICS, DRAWN_AT, 2.0)
    assert found.inliers == 40
    assert found.world_from_cam.translation_m == pytest.approx(TRUTH.translation_m, abs=1e-4)
    assert found.rms_px < 1e-2


def test_a_third_of_wrong_matches_does_not_move_the_pose():
    exact = exact_matches(60)
    uv_px = exact.uv_px.copy()
    uv_px[::3] = np.random.default_rng(6).uniform(0, 120, (20, 2))
    found = solve_pose(Matches(uv_px, exact.xyz_m), INTRINSICS, DRAWN_AT, 2.0)
    assert 38 <= found.inliers <= 42
    assert found.world_from_cam.translation_m == pytest.approx(TRUTH.translation_m, abs=0.02)


def test_few_matches_and_matches_of_one_point_give_no_pose():
    few = exact_matches(5)
    assert solve_pose(few, INTRINSICS, DRAWN_AT, 2.0) is None
    same = Matches(np.repeat(few.uv_px[:1], 30, axis=0), np.repeat(few.xyz_m[:1], 30, axis=0))
    assert solve_pose(same, INTRINSICS, DRAWN_AT, 2.0) is None


def slanted_view() -> View:
    """A plane whose inverse depth rises along both axes of the picture."""
    row, column = np.mgrid[0:120, 0:160]
    depth = (1.0 / (0.05 + 0.0005 * row + 0.0002 * column)).astype(np.float32)
    return View(np.zeros((120, 160, 3), np.float32), depth, np.ones((120, 160), np.float32))


def test_a_place_between_pixels_of_a_plane_is_lifted_onto_the_plane():
    drawn_px = np.array([[20.25, 30.75], [159.0, 119.0], [0.0, 0.0]])
    points = lift_matches((drawn_px, drawn_px), slanted_view(), INTRINSICS, 0.5).xyz_m
    u, v = drawn_px.T
    assert points[:, 2] == pytest.approx(1.0 / (0.05 + 0.0005 * v + 0.0002 * u), rel=1e-6)
    camera = Camera(INTRINSICS, Pose.identity())
    again = [camera.project(point)[:2] for point in points.tolist()]
    assert np.array(again) - 0.5 == pytest.approx(drawn_px, abs=1e-6)


def test_places_without_a_trusted_depth_are_left_out():
    view = slanted_view()
    view.depth[10:20, 10:20] = 0.0
    view.opacity[40:50] = 0.1
    drawn_px = np.array([[15.0, 15.0], [80.0, 45.0], [100.0, 100.0]])
    kept = lift_matches((drawn_px, drawn_px), view, INTRINSICS, 0.5)
    assert kept.uv_px.tolist() == [[100.0, 100.0]]


def test_a_match_needs_a_clear_lead_over_the_second_nearest():
    def at(*values: float) -> Features:
        descriptors = np.zeros((len(values), 128), np.float32)
        descriptors[:, 0] = values
        return Features(np.array([[v, 0.0] for v in values]), descriptors)

    clear, drawn_px = match_features(at(1.0, 55.0), at(0.0, 50.0, 60.0), 0.8)
    assert clear.tolist() == [[1.0, 0.0]]
    assert drawn_px.tolist() == [[0.0, 0.0]]
    assert len(match_features(at(1.0, 2.0), at(0.0), 0.8)[0]) == 0


def test_a_flat_picture_has_no_features_and_a_cornered_one_has_them_at_its_corners():
    flat = np.full((120, 160), 90, np.uint8)
    assert find_features(flat, 100).uv_px.shape == (0, 2)
    assert find_features(flat, 100).descriptors.shape == (0, 128)
    flat[40:60, 70:90] = 220
    found = find_features(flat, 100).uv_px
    assert len(found) > 0
    away = np.abs(found - [79.5, 49.5]).max(axis=1)
    assert away.max() < 25
