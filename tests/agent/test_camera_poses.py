"""Where a rig is, from its reference camera: measured, tracked, extrapolated, and lost."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from cav_agent.camera_poses import (
    CameraLocation,
    MeasuredRigPoses,
    PoseSource,
    RecordedRigPoses,
    RigPose,
    TrackedRigPoses,
)
from cav_agent.frames import Capture
from rfcore.camera import Camera, Intrinsics, Pose, camera_on_rig
from rfcore.codec.sender.ladder import FULL_RUNG, Rung
from rfcore.image import I420
from rfcore.localise.estimate import LocalisationState, PoseMeasurement

MakeCapture = Callable[..., Capture]
INTRINSICS = Intrinsics(32, 16, 20.0, 20.0, 16.0, 8.0)
CAMERA_FROM_RIG = Pose((0.0, 1.6, -0.5), (0.5, -0.5, 0.5, -0.5))
GREY = I420(*(np.full(shape, 128, np.uint8) for shape in ((16, 32), (8, 16), (8, 16))))
NS = 1_000_000_000


def driving(seconds: float) -> Pose:
    """Return world_from_rig of a vehicle at 8 m/s that turns by 0.1 rad/s."""
    half = 0.05 * seconds
    return Pose((8.0 * seconds, 1.0, 0.0), (math.cos(half), 0.0, 0.0, math.sin(half)))


class Reference(PoseSource):
    """Measures, or finds, the reference camera where ``driving`` has it; ``found``: or not."""

    def __init__(self) -> None:
        self.found = True

    def camera(self, capture: Capture) -> Camera:
        pose = camera_on_rig(driving(capture.capture_time_ns / NS), CAMERA_FROM_RIG)
        return Camera(INTRINSICS, pose)

    def time_ns(self, capture: Capture) -> int:
        return capture.capture_time_ns

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        raise NotImplementedError

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:
        assert (frame, rung) == (GREY, FULL_RUNG)
        if not self.found:
            return CameraLocation(None, None, LocalisationState.LOST)
        camera = self.camera(capture)
        return CameraLocation(camera, camera.world_from_cam, LocalisationState.TRACKING)


@pytest.fixture
def at(make_capture: MakeCapture) -> Callable[[float], Capture]:
    def capture(seconds: float) -> Capture:
        return replace(make_capture(0), capture_time_ns=round(seconds * NS))

    return capture


def apart_m(at: RigPose, seconds: float) -> float:
    found = at.world_from_rig
    assert found is not None
    assert found == found.rounded()
    return math.dist(found.translation_m, driving(seconds).translation_m)


def test_a_drive_has_the_rigs_pose_itself(make_capture: MakeCapture) -> None:
    pose = driving(1.0).rounded()
    assert RecordedRigPoses().at(replace(make_capture(0), world_from_rig=pose)) == RigPose(pose)


def test_a_measured_reference_camera_says_where_the_rig_is(at: Callable[[float], Capture]) -> None:
    rig = MeasuredRigPoses(Reference(), CAMERA_FROM_RIG)
    assert apart_m(rig.at(at(2.0)), 2.0) < 1e-5


def test_what_was_found_in_one_camera_is_extrapolated_to_the_others_times(
    at: Callable[[float], Capture],
) -> None:
    reference = Reference()
    rig = TrackedRigPoses(reference, CAMERA_FROM_RIG, RecordedRigPoses())
    for seconds in (1.0, 1.1):
        rig.track(at(seconds), GREY, FULL_RUNG)
        assert apart_m(rig.at(at(seconds)), seconds) < 1e-5
    assert apart_m(rig.at(at(1.15)), 1.15) < 0.01, "half a frame later"
    assert apart_m(rig.at(at(1.05)), 1.05) < 0.01, "half a frame before"


def test_where_the_reference_is_lost_the_rig_is(at: Callable[[float], Capture]) -> None:
    reference = Reference()
    rig = TrackedRigPoses(reference, CAMERA_FROM_RIG, RecordedRigPoses())
    rig.track(at(1.0), GREY, FULL_RUNG)
    reference.found = False
    rig.track(at(1.1), GREY, FULL_RUNG)
    assert rig.at(at(1.12)) == RigPose(None, LocalisationState.LOST)


def test_once_the_reference_is_gone_measured_poses_take_over(
    at: Callable[[float], Capture],
) -> None:
    reference = Reference()
    rig = TrackedRigPoses(reference, CAMERA_FROM_RIG, MeasuredRigPoses(reference, CAMERA_FROM_RIG))
    assert apart_m(rig.at(at(0.5)), 0.5) < 1e-5, "before it ever sent"
    rig.track(at(1.0), GREY, FULL_RUNG)
    assert apart_m(rig.at(at(9.0)), 9.0) < 1e-4
