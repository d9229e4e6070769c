"""Finds where a camera took a picture: the pose that the field is rendered at, and that is sent.

A pose comes from a ``PoseSource`` (the dataset, a feed, a trajectory), or is found in the field
(``cav_agent.tracking``). The cameras of a rig follow from the rig's pose and their extrinsics. The
rig's pose comes from its reference camera, whatever says where that is. It is rounded as it is sent
before any camera's follows from it, so that both ends render at the same one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from cav_agent.frames import Capture
from rfcore.camera import Camera, Pose, Vec3, camera_on_rig
from rfcore.codec.sender.ladder import Rung
from rfcore.image import I420
from rfcore.localise.estimate import LocalisationState, PoseEstimate, PoseMeasurement
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.views import FieldView

NS = 1_000_000_000

STAND_IN_STD_M, STAND_IN_STD_DEG = 0.5, 1.0
"""Exact poses stand in for a sensor as good as that where a camera is looked for in the field."""

REFERENCE_SILENT_NS = NS
"""A reference camera that gave no picture for so long is gone: measured poses take over."""


@dataclass(frozen=True)
class CameraLocation:
    """The place at which a camera took a picture; ``camera`` is ``None`` while it is lost.

    ``pose``: the one to send, the camera's or its rig's. ``state``: how it was found in the field,
    where that is done. ``fix``: what the camera's tracker found. ``view``: what the field shows
    there, where it was rendered to find the camera.
    """

    camera: Camera | None
    pose: Pose | None
    state: LocalisationState | None = None
    fix: PoseEstimate | None = None
    view: FieldView | None = None


class CameraPoses(Protocol):
    """Locates one camera; called once for each of its pictures, in order."""

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:
        """Return where a picture was taken; raise ``RfedgeError`` before anything is known."""


# --- one camera


class PoseSource(Protocol):
    """A source of a camera's measured poses, in a field's axes."""

    def camera(self, capture: Capture) -> Camera:
        """Return a picture's camera, its pose rounded as it is sent; raise ``RfedgeError``."""

    def time_ns(self, capture: Capture) -> int:
        """Return when a picture was taken, on the clock of the measurements."""

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return the poses measured up to a picture's time, each once."""

    def localised(self, time_ns: int, position_m: Vec3) -> None:  # noqa: ARG002
        """Learn from where a tracked picture was taken; most sources learn nothing."""
        return

    def offset_s(self) -> float | None:
        """Return what to add to the times of measurements to get the pictures', if it is known."""
        return None


def stand_in_measurement(time_ns: int, pose: Pose) -> PoseMeasurement:
    """Return an exact pose as the measurement of a sensor."""
    std_m = (STAND_IN_STD_M,) * 3
    return PoseMeasurement(time_ns, pose.translation_m, std_m, pose.rotation, STAND_IN_STD_DEG)


class DatasetPoses(PoseSource):
    """The dataset's pose of each picture."""

    def camera(self, capture: Capture) -> Camera:
        """Return the picture's camera; drives are rounded when they are read."""
        return capture.picture.camera

    def time_ns(self, capture: Capture) -> int:
        """Return the time of capture."""
        return capture.capture_time_ns

    def measurements(self, capture: Capture) -> list[PoseMeasurement]:
        """Return one measurement: the picture's own pose."""
        pose = capture.picture.camera.world_from_cam
        return [stand_in_measurement(capture.capture_time_ns, pose)]


class KnownPoses:
    """The poses of a source as they are, without a look at the picture."""

    def __init__(self, source: PoseSource) -> None:
        self._source = source

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:  # noqa: ARG002
        """Return where the source says that the camera was."""
        camera = self._source.camera(capture)
        return CameraLocation(camera, camera.world_from_cam)


# --- cameras on a rig


@dataclass(frozen=True)
class RigPose:
    """A rig's pose when a picture was taken, rounded as it is sent; ``None``: it is lost.

    ``state``: how it was found in the field, if it is looked for there.
    """

    world_from_rig: Pose | None
    state: LocalisationState | None = None


class RigPoses(Protocol):
    """Locates a rig."""

    def at(self, capture: Capture) -> RigPose:
        """Return the rig's pose at a capture; raise ``RfedgeError`` before anything is known."""


class RecordedRigPoses:
    """The poses of a recorded drive."""

    def at(self, capture: Capture) -> RigPose:
        """Return the pose that came with the picture."""
        return RigPose(capture.world_from_rig)


class MeasuredRigPoses:
    """The poses of a feed or a trajectory, which are those of the reference camera."""

    def __init__(self, source: PoseSource, camera_from_rig: Pose) -> None:
        self._source, self._camera_from_rig = source, camera_from_rig

    def at(self, capture: Capture) -> RigPose:
        """Return the pose at the picture's own time."""
        reference = self._source.camera(capture).world_from_cam
        return RigPose(reference.compose(self._camera_from_rig).rounded())


class TrackedRigPoses:
    """The rig where ``tracking`` finds its reference camera, ``measured`` once that has fallen
    silent. One caller at a time, the reference's pictures first."""

    def __init__(self, tracking: CameraPoses, camera_from_rig: Pose, measured: RigPoses) -> None:
        self._tracking, self._camera_from_rig = tracking, camera_from_rig
        self._measured = measured
        self._last: tuple[int, Pose] | None = None
        self._before: tuple[int, Pose] | None = None
        self._tracked_ns: int | None = None
        self._state: LocalisationState | None = None

    def track(self, capture: Capture, frame: I420, rung: Rung) -> PoseEstimate | None:
        """Look for the rig in a picture of its reference camera; return what was found."""
        location = self._tracking.locate(capture, frame, rung)
        self._tracked_ns, self._state = capture.capture_time_ns, location.state
        if location.camera is None:
            self._last = self._before = None
        else:
            pose = location.camera.world_from_cam.compose(self._camera_from_rig)
            self._before, self._last = self._last, (capture.capture_time_ns, pose)
        return location.fix

    def at(self, capture: Capture) -> RigPose:
        """Return the tracked pose, extrapolated at its speed to the picture's time."""
        time_ns = capture.capture_time_ns
        if self._tracked_ns is None or time_ns - self._tracked_ns > REFERENCE_SILENT_NS:
            return self._measured.at(capture)
        if self._last is None:
            return RigPose(None, self._state)
        pose = self._last[1]
        if self._before is not None and time_ns != self._last[0]:
            pose = _extrapolated(self._before, self._last, time_ns)
        return RigPose(pose.rounded(), self._state)


def _extrapolated(before: tuple[int, Pose], last: tuple[int, Pose], time_ns: int) -> Pose:
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


class RigCameraPoses:
    """One camera of a rig; ``reference``: given for the camera by which the rig is tracked."""

    def __init__(
        self, camera_from_rig: Pose, rig: RigPoses, reference: TrackedRigPoses | None = None
    ) -> None:
        self._camera_from_rig, self._rig, self._reference = camera_from_rig, rig, reference

    def locate(self, capture: Capture, frame: I420, rung: Rung) -> CameraLocation:
        """Return the pose that the rig's gives the camera: the very one that its receiver finds."""
        fix = None if self._reference is None else self._reference.track(capture, frame, rung)
        found = self._rig.at(capture)
        if found.world_from_rig is None:
            return CameraLocation(None, None, found.state, fix)
        pose = camera_on_rig(found.world_from_rig, self._camera_from_rig)
        camera = Camera(capture.picture.camera.intrinsics, pose)
        return CameraLocation(camera, found.world_from_rig, found.state, fix)
