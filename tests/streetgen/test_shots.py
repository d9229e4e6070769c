"""Splits: where the pictures are taken, and that evaluation never sees a training pose."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.camera import Pose
from rfcore.dataset.rig import RIG
from rfcore.errors import InvalidInput
from streetgen.scene_file import DriveSettings, LocalisationNoise, RigSettings, Scene
from streetgen.shots import Selection, Shot, Split, shots_of, thinned_indices
from streetgen.trajectory import (
    drive_motion,
    drive_pose,
    looking,
    measured_pose,
    mounted,
    on_lane,
)

SCENE = Scene("street", "street")


def forward(pose: Pose) -> np.ndarray:
    return np.array(pose.rotation_matrix())[:, 2]


def places(shots: list[Shot]) -> np.ndarray:
    return np.array([shot.camera.world_from_cam.translation_m for shot in shots])


def test_the_published_evaluation_is_eighteen_cameras_at_eight_stations():
    shots = shots_of(SCENE, Split.EVAL)
    assert len(shots) == 144
    assert len(shots_of(SCENE, Split.TRAIN)) == SCENE.train.views
    views = {tuple(np.round(forward(s.camera.world_from_cam), 6)) for s in shots[:18]}
    assert len(views) == 18


def test_no_evaluation_pose_is_a_training_pose():
    """Nothing within 5 cm that looks within 1 degree of the same way."""
    trained = shots_of(SCENE, Split.TRAIN)
    for shot in shots_of(SCENE, Split.EVAL):
        away = np.linalg.norm(places(trained) - places([shot]), axis=1)
        for i in np.nonzero(away < 0.05)[0]:
            towards = forward(trained[i].camera.world_from_cam)
            assert towards @ forward(shot.camera.world_from_cam) < np.cos(np.radians(1.0))


def test_training_uses_every_camera_in_both_directions():
    shots = shots_of(SCENE, Split.TRAIN)
    heights = {round(shot.camera.world_from_cam.translation_m[2], 3) for shot in shots}
    assert heights == {0.5, 2.5, 5.5}
    level = np.array([forward(s.camera.world_from_cam) for s in shots])
    assert (level[:, 0] > 0.9).any()
    assert (level[:, 0] < -0.9).any()
    x = places(shots)[:, 0]
    assert x.min() < -40
    assert x.max() > 40


def test_cars_that_drive_there_keep_to_one_side():
    there = replace(SCENE, rig=RigSettings(cameras=1, directions="there"))
    shots = shots_of(there, Split.TRAIN)
    assert places(shots)[:, 1].max() < -1.5
    assert all(forward(shot.camera.world_from_cam)[0] > 0.9 for shot in shots)


def test_the_drive_goes_at_its_speed_and_rate():
    scene = replace(SCENE, drive=DriveSettings(duration_s=2.0, speed_mps=12.0, rate_hz=30.0))
    shots = shots_of(scene, Split.DRIVE, (160, 90))
    assert len(shots) == 60
    assert shots[0].camera.intrinsics.fx_px == pytest.approx(80.0)
    steps = np.diff(places(shots)[:, 0])
    np.testing.assert_allclose(steps, 12.0 / 30.0, rtol=1e-9)
    assert abs(places(shots)[:, 0].mean() + 0.2) < 1e-9, "about the middle of the street"


def test_lower_rates_are_every_nth_frame():
    assert list(thinned_indices(SCENE, 10.0))[:4] == [0, 3, 6, 9]
    assert list(thinned_indices(SCENE, 2.0))[:3] == [0, 15, 30]


@pytest.mark.parametrize("offset_m", [-0.5, 0.0, 1.2])
def test_a_lane_offset_moves_the_drive_to_its_left(offset_m):
    lane, moved = (
        drive_pose(DriveSettings(), 1.0),
        drive_pose(DriveSettings(lane_offset_m=offset_m), 1.0),
    )
    shift = np.array(moved.translation_m) - np.array(lane.translation_m)
    np.testing.assert_allclose(shift, [0, offset_m, 0], atol=1e-12)


def test_velocity_and_turn_carry_one_pose_to_the_next():
    """To first order: what is left over a step dt is the acceleration's dt^2 / 2."""
    drive, dt = DriveSettings(), 1e-4
    for time_s in (0.3, 1.1, 2.0):
        motion = drive_motion(drive, time_s)
        now, then = drive_pose(drive, time_s), drive_pose(drive, time_s + dt)
        step = now.inverse().compose(then)
        np.testing.assert_allclose(
            step.translation_m, np.array(motion.velocity_mps) * dt, atol=1e-8
        )
        half = np.array(motion.turn_radps) * dt / 2
        np.testing.assert_allclose(step.rotation[1:], half, atol=1e-8)


def test_a_camera_looks_where_it_is_told():
    pose = looking(np.zeros(3), np.radians(90), np.radians(30))
    np.testing.assert_allclose(forward(pose), [0, np.sqrt(0.75), 0.5], atol=1e-9)
    down = np.array(pose.rotation_matrix())[:, 1]
    assert down[2] < 0


def test_the_rig_is_mounted_in_the_cars_axes():
    """The right camera of a car that drives along -x looks along +y, a metre to that side."""
    right = next(mount for mount in RIG if mount.name == "mid_right")
    place, heading = on_lane(10.0, -1, 0.0)
    pose = mounted(right, place, heading)
    np.testing.assert_allclose(pose.translation_m, [10.0, 2.1 + 1.0, 2.5], atol=1e-12)
    np.testing.assert_allclose(forward(pose), [0, 1, 0], atol=1e-12)


def test_measured_poses_are_off_by_what_is_declared():
    """900 deviates: their deviation is known to 1 / sqrt(2 n), 2.4 %; five of those are allowed."""
    noise = LocalisationNoise(position_m=0.05, rotation_deg=0.2, seed=4)
    true = looking(np.array([3.0, 2.0, 1.0]), 0.4, 0.1)
    measured = [measured_pose(true, noise, frame) for frame in range(300)]
    shift = np.array([m.translation_m for m in measured]) - true.translation_m
    turn = np.array([true.inverse().compose(m).rotation[1:] for m in measured]) * 2
    assert shift.std() == pytest.approx(0.05, rel=0.12)
    assert np.degrees(turn.std()) == pytest.approx(0.2, rel=0.12)
    assert measured[7] == measured_pose(true, noise, 7)


def test_no_noise_measures_the_true_pose():
    true = looking(np.array([3.0, 2.0, 1.0]), 0.4, 0.1)
    measured = measured_pose(true, LocalisationNoise(), 3)
    assert measured.translation_m == true.translation_m
    np.testing.assert_allclose(measured.rotation, true.rotation, atol=1e-15)


@pytest.mark.parametrize(
    ("splits", "frames", "count"),
    [("drive", None, 72), ("all", None, 336), ("default", "0:8", 8), ("eval,train", "100:", 164)],
)
def test_a_selection_counts_through_the_splits(splits, frames, count):
    shots = Selection(SCENE, splits, frames).shots()
    assert len(shots) == count
    assert len({(shot.split, shot.index) for shot in shots}) == count
    assert len({shot.number for shot in shots}) == count


def test_a_scene_with_anothers_field_is_not_trained_on():
    parked = replace(SCENE, name="street-parked")
    assert {shot.split for shot in Selection(parked).shots()} == {Split.DRIVE, Split.EVAL}
    assert {shot.split for shot in Selection(parked, "all").shots()} == set(Split) - {Split.RIG}


@pytest.mark.parametrize(
    ("splits", "frames", "said"),
    [
        ("drive,test", None, "split: 'test' is none of drive, train, eval"),
        ("all", "8", "frames: '8' is not a:b"),
        ("drive", "72:80", "leaves none of 72 frames"),
        ("drive", "5:5", "leaves none"),
    ],
)
def test_a_selection_that_is_none_is_refused(splits, frames, said):
    with pytest.raises(InvalidInput, match=said):
        Selection(SCENE, splits, frames)


def test_the_rig_drives_as_the_drive_does_and_only_if_asked_for():
    scene = replace(SCENE, drive=DriveSettings(duration_s=0.5, rate_hz=10.0, thinned_hz=()))
    assert all(shot.split is not Split.RIG for shot in Selection(scene, "all").shots())
    shots = Selection(scene, "rig").shots()
    assert len(shots) == 5 * 4
    for instant in range(5):
        front, left, right, back = shots[4 * instant : 4 * instant + 4]
        assert {s.time_s for s in (front, left, right, back)} == {instant / 10.0}
        ahead = forward(drive_pose(scene.drive, front.time_s)) * (1, 1, 0)
        ahead /= np.linalg.norm(ahead)
        assert forward(front.camera.world_from_cam) @ ahead == pytest.approx(1.0, abs=1e-6)
        assert forward(back.camera.world_from_cam) @ ahead == pytest.approx(-1.0, abs=1e-6)
        sideways = np.cross((0.0, 0.0, 1.0), ahead)
        assert forward(left.camera.world_from_cam) @ sideways == pytest.approx(1.0, abs=1e-6)
        assert forward(right.camera.world_from_cam) @ sideways == pytest.approx(-1.0, abs=1e-6)
        assert left.motion.velocity_mps[0] == pytest.approx(9.0, abs=0.5), "it drives to its right"


def test_a_rig_of_cameras_that_are_not_is_refused():
    with pytest.raises(InvalidInput, match="roof"):
        DriveSettings(rig="mid_front,roof")
