"""The pose as a vehicle's localisation gives it: the true one with normal deviates."""

from __future__ import annotations

import math

import numpy as np

from rfcore.camera import Pose
from rfedge.street.scene_file import PoseNoise

__all__ = ["measured_pose"]


def measured_pose(world_from_cam: Pose, noise: PoseNoise, frame: int) -> Pose:
    """Return the pose measured in a frame: the same for the same seed and frame.

    Each coordinate is off by ``position_m``, each angle about a camera axis by ``rotation_deg``
    (standard deviations).
    """
    rng = np.random.default_rng([noise.seed, frame])
    shift = rng.normal(0.0, 1.0, 3) * noise.position_m
    turn = rng.normal(0.0, 1.0, 3) * math.radians(noise.rotation_deg)
    x, y, z = (float(a + b) for a, b in zip(world_from_cam.translation_m, shift, strict=True))
    angle = float(np.linalg.norm(turn))
    a, b, c = (float(v) for v in turn * (math.sin(angle / 2) / angle if angle > 0 else 0.0))
    off = Pose((0.0, 0.0, 0.0), (math.cos(angle / 2), a, b, c))
    return Pose((x, y, z), world_from_cam.compose(off).rotation)
