"""Compute the motion of cars, the poses of their cameras, and the poses that they measure.

A car's axes are x forward, y left, z up, with the origin on the road. Traffic keeps right: cars
driving towards +x are at y < 0. Camera axes are OpenCV's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from rfcore.camera import Pose
from rfcore.dataset.rig import Mount
from rfcore.motion import quaternion_from_vector, rotation_vector
from streetgen.geometry.layout import LANE_M
from streetgen.geometry.mesh import F64
from streetgen.scene_file import DriveSettings, LocalisationNoise

EYE_UP_M = 1.62
"""The drive's camera is behind the windscreen."""
SWAY_M, SWAY_PERIOD_S = 0.2, 7.3
YAW_RAD, YAW_PERIOD_S = 0.02, 4.8
PITCH_RAD, PITCH_PERIOD_S = 0.003, 0.7
STEP_S = 1e-3


@dataclass(frozen=True)
class CameraMotion:
    """A camera's velocity and turn rate, in its own axes."""

    velocity_mps: tuple[float, float, float]
    turn_radps: tuple[float, float, float]


def looking(position_m: F64, yaw_rad: float, pitch_rad: float) -> Pose:
    """Return world_from_cam of a level camera: yaw from x towards y, pitch up."""
    forward = np.array(
        [
            np.cos(yaw_rad) * np.cos(pitch_rad),
            np.sin(yaw_rad) * np.cos(pitch_rad),
            np.sin(pitch_rad),
        ]
    )
    right = np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0.0])
    axes = np.stack([right, np.cross(forward, right), forward, position_m], axis=1)
    return Pose.from_matrix(axes.tolist())


def on_lane(x_m: float, direction: int, left_m: float) -> tuple[F64, float]:
    """Return place and heading of a car driving along +x or -x, ``left_m`` beside its lane."""
    place = np.array([x_m, direction * (left_m - LANE_M), 0.0])
    return place, 0.0 if direction > 0 else float(np.pi)


def mounted(mount: Mount, place: F64, heading_rad: float) -> Pose:
    """Return world_from_cam of a camera of the rig, in whose axes y is right and yaw clockwise."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    forward_m, left_m = mount.x_m, -mount.y_m
    shift = np.array([cos * forward_m - sin * left_m, sin * forward_m + cos * left_m, mount.z_m])
    yaw_rad = heading_rad - np.radians(mount.yaw_deg)
    return looking(place + shift, float(yaw_rad), float(np.radians(mount.pitch_deg)))


def drive_pose(drive: DriveSettings, time_s: float) -> Pose:
    """Return world_from_cam of the drive, centred on the street, with a car's sway."""
    place, yaw_rad = _car(drive, time_s)
    pitch = PITCH_RAD * np.sin(2 * np.pi * time_s / PITCH_PERIOD_S)
    return looking(place + np.array([0.0, 0.0, EYE_UP_M]), yaw_rad, float(pitch))


def rig_pose(drive: DriveSettings, mount: Mount, time_s: float) -> Pose:
    """Return world_from_cam of a camera on the car that takes the drive, which does not pitch."""
    return mounted(mount, *_car(drive, time_s))


def _car(drive: DriveSettings, time_s: float) -> tuple[F64, float]:
    """Return place on the road and heading of the car that takes the drive."""
    x_m = drive.speed_mps * (time_s - 0.5 * drive.duration_s)
    rate = 2 * np.pi / SWAY_PERIOD_S
    left_m = drive.lane_offset_m + SWAY_M * np.sin(rate * time_s)
    place, _ = on_lane(x_m, 1, left_m)
    sideways_mps = SWAY_M * rate * np.cos(rate * time_s)
    heading = np.arctan2(sideways_mps, max(drive.speed_mps, 1.0))
    yaw = heading + YAW_RAD * np.sin(2 * np.pi * time_s / YAW_PERIOD_S)
    return place, float(yaw)


def drive_motion(drive: DriveSettings, time_s: float) -> CameraMotion:
    """Return the drive's velocity and turn rate by differences over 2 ms."""
    return _motion(partial(drive_pose, drive), time_s)


def rig_motion(drive: DriveSettings, mount: Mount, time_s: float) -> CameraMotion:
    """Return the velocity and turn rate of a camera on the car that takes the drive."""
    return _motion(partial(rig_pose, drive, mount), time_s)


def _motion(pose_at: Callable[[float], Pose], time_s: float) -> CameraMotion:
    before, after = (pose_at(time_s + step) for step in (-STEP_S, STEP_S))
    now = np.array(pose_at(time_s).rotation_matrix())
    moved = np.array(after.translation_m) - np.array(before.translation_m)
    turned = np.array(rotation_vector(before.inverse().compose(after).rotation))
    velocity = now.T @ moved / (2 * STEP_S)
    return CameraMotion(_triple(velocity), _triple(turned / (2 * STEP_S)))


def _triple(values: F64) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def measured_pose(world_from_cam: Pose, noise: LocalisationNoise, frame: int) -> Pose:
    """Return the pose measured in a frame: the same for the same seed and frame.

    Each coordinate is off by ``position_m``, each angle about a camera axis by ``rotation_deg``
    (standard deviations).
    """
    rng = np.random.default_rng([noise.seed, frame])
    shift = rng.normal(0.0, 1.0, 3) * noise.position_m
    turn = rng.normal(0.0, 1.0, 3) * math.radians(noise.rotation_deg)
    x, y, z = (float(a + b) for a, b in zip(world_from_cam.translation_m, shift, strict=True))
    off = Pose((0.0, 0.0, 0.0), quaternion_from_vector(_triple(turn)))
    return Pose((x, y, z), world_from_cam.compose(off).rotation)
