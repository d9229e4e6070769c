"""Where a rig is, for each picture of its cameras: from the reference camera, by extrinsics.

Whatever says where the reference camera is (the drive, a feed, a trajectory, or its picture in the
field) says where the rig is, and so where every camera is. The rig's pose is rounded as it is sent
before any camera's follows from it, so that both ends render at the same one.
"""

from __future__ import annotations

from typing import Protocol

from cav_agent.frames import Capture, RigPose
from rfcore.camera import Camera, Pose
from rfcore.codec.sender.ladder import Rung
from rfcore.image import I420
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.motion import quaternion_from_vector, rotation_vector

__all__ = ["DrivenRig", "MeasuredRig", "ReferenceTracking", "RigPoses", "TrackedRig"]

NS = 1_000_000_000

REFERENCE_SILENT_NS = NS
"""A reference camera that gave no picture for so long is gone: measured poses take over."""


class RigPoses(Protocol):
    """Says where the rig was."""

    def at(self, capture: Capture) -> RigPose:
        """Return the rig's pose at a picture's capture.

        Raises ``RfedgeError`` before anything is known.
        """


class ReferencePoses(Protocol):
    """Says where the reference camera is (``cav_agent.pose_feed``, ``cav_agent.live``)."""

    def camera(self, capture: Capture) -> Camera:
        """Return it at the time of a picture of any camera; raise ``RfedgeError``."""


class ReferenceTracking(Protocol):
    """Finds the reference camera in the field (``cav_agent.tracking``)."""

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> PoseEstimate:
        """Return what is known of a picture's pose."""


class DrivenRig:
    """The drive's own poses."""

    def at(self, capture: Capture) -> RigPose:
        """Return the pose that came with the picture."""
        return RigPose(capture.world_from_rig)


class MeasuredRig:
    """The poses of a feed or a trajectory, which are of the reference camera."""

    def __init__(self, poses: ReferencePoses, camera_from_rig: Pose) -> None:
        self._poses, self._camera_from_rig = poses, camera_from_rig

    def at(self, capture: Capture) -> RigPose:
        """Return the pose at the picture's own time."""
        reference = self._poses.camera(capture).world_from_cam
        return RigPose(reference.compose(self._camera_from_rig).rounded())


class TrackedRig:
    """The rig where ``tracking`` finds its reference camera; ``measured`` once that has fallen
    silent. One caller at a time, the reference's pictures first."""

    def __init__(
        self, tracking: ReferenceTracking, camera_from_rig: Pose, measured: RigPoses
    ) -> None:
        self._tracking, self._camera_from_rig = tracking, camera_from_rig
        self._measured = measured
        self._last: tuple[int, Pose] | None = None
        self._before: tuple[int, Pose] | None = None
        self._heard_ns: int | None = None
        self._state: LocalisationState | None = None

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> PoseEstimate:
        """Look for the rig in the picture of its reference camera."""
        fix = self._tracking.locate(capture, frame, rung)
        self._heard_ns, self._state = capture.capture_time_ns, fix.state
        found = fix.world_from_cam
        if found is None:
            self._last = self._before = None
        else:
            pose = found.compose(self._camera_from_rig)
            self._before, self._last = self._last, (capture.capture_time_ns, pose)
        return fix

    def at(self, capture: Capture) -> RigPose:
        """Return the tracked pose, carried on at its speed to the picture's time."""
        time_ns = capture.capture_time_ns
        if self._heard_ns is None or time_ns - self._heard_ns > REFERENCE_SILENT_NS:
            return self._measured.at(capture)
        if self._last is None:
            return RigPose(None, self._state)
        pose = self._last[1]
        if self._before is not None and time_ns != self._last[0]:
            pose = _carried(self._before, self._last, time_ns)
        return RigPose(pose.rounded(), self._state)


def _carried(before: tuple[int, Pose], last: tuple[int, Pose], time_ns: int) -> Pose:
    """Return the pose at a time near ``last``, at constant speed and turn."""
    step_ns = last[0] - before[0]
    if step_ns <= 0:
        return last[1]
    share = (time_ns - last[0]) / step_ns
    moved = before[1].inverse().compose(last[1])
    x, y, z = (share * value for value in rotation_vector(moved.rotation))
    dx, dy, dz = (
        share * (b - a) for a, b in zip(before[1].translation_m, last[1].translation_m, strict=True)
    )
    turned = last[1].compose(Pose((0.0, 0.0, 0.0), quaternion_from_vector((x, y, z))))
    px, py, pz = last[1].translation_m
    return Pose((px + dx, py + dy, pz + dz), turned.rotation)
