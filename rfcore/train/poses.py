"""Poses learned with the field: every picture's camera moves a little, down the loss's gradient.

Moving the camera by a translation t in the world is moving all Gaussians by -t; turning it by a
rotation vector w about its centre c is turning all Gaussians by -w about c. So the gradients of
means m and quaternions q, which the kernels give, are those of the pose (first order, world axes):

    dL/dt = -sum g_m
    dL/dw = -sum (m - c) x g_m  -  1/2 sum (q_w g_v - g_w q_v + q_v x g_v),

with q = (q_w, q_v) and its gradient (g_w, g_v). Turning the Gaussians also turns the directions
they are seen from, which turning the camera does not: for colours that depend on direction the
second line is off by what that changes, little beside the displacement in the picture.

Corrections have mean zero over the pictures, so that the field stays where the dataset put it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose, Vec3
from rfcore.field import SplatField
from rfcore.motion import quaternion_from_vector, rotation_vector
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.trainable import TrainableRasterizer
from rfcore.train.targets import PictureAdam, Target
from rfcore.views import PosedPicture

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

EPSILON = 1e-15
STEP_PX = 0.1
"""Most that a step at the start moves the picture, in pixels."""
ALIGN_STEPS = 40
"""Steps of aligning a picture with a field that is kept as it is."""
FALL = 0.05
"""The rate at the end, as a share of that at the start."""


@dataclass(frozen=True)
class PoseCorrection:
    """The change of a picture's pose in metres and degrees."""

    name: str
    moved_m: float
    turned_deg: float


def pose_gradient(gaussians: Gaussians, gradients: Mapping[str, F32], centre_m: Vec3) -> F64:
    """Return the gradient of the loss by translation (3) and rotation vector (3) of a camera at
    ``centre_m``, in world axes.

    ``gradients`` are those of ``TrainableRasterizer.gradients`` after its ``backward``.
    """
    g_mean = gradients["means"].astype(np.float64)
    seen = np.flatnonzero(g_mean.any(axis=1))
    g_mean, q = g_mean[seen], gaussians.quaternions[seen].astype(np.float64)
    offset = gaussians.means[seen].astype(np.float64) - centre_m
    g = gradients["quaternions"][seen].astype(np.float64)
    turn = q[:, :1] * g[:, 1:] - g[:, :1] * q[:, 1:] + np.cross(q[:, 1:], g[:, 1:])
    swing = np.cross(offset, g_mean) + 0.5 * turn
    return -np.concatenate([g_mean.sum(axis=0), swing.sum(axis=0)])


def typical_depth_m(gaussians: Gaussians, cameras: Sequence[Camera]) -> float:
    """Return the median distance of the Gaussians in front of the cameras, at least 1 mm.

    It looks at a hundred Gaussians from every camera, which is enough.
    """
    step = max(1, len(gaussians) // 100)
    points = gaussians.means[::step].astype(np.float64)
    depths = [depth for camera in cameras for depth in _depths(camera, points) if depth > 0]
    return max(float(np.median(depths)), 1e-3) if depths else 1.0


def _depths(camera: Camera, points: F64) -> list[float]:
    """Return z of points [N, 3] in a camera's axes."""
    rotation = np.array(camera.world_from_cam.rotation_matrix())
    depths: list[float] = ((points - camera.world_from_cam.translation_m) @ rotation[:, 2]).tolist()
    return depths


def corrected(camera: Camera, correction: F64) -> Camera:
    """Return a camera moved and turned in world axes by a translation and a rotation vector [6]."""
    x, y, z, a, b, c = correction.tolist()
    pose = camera.world_from_cam
    turn = Pose((0.0, 0.0, 0.0), quaternion_from_vector((a, b, c)))
    rotation = turn.compose(Pose((0.0, 0.0, 0.0), pose.rotation)).rotation
    px, py, pz = pose.translation_m
    return replace(camera, world_from_cam=Pose((px + x, py + y, pz + z), rotation))


class PoseModel:
    """The corrections of a run's cameras [V, 6], learned by Adam when a picture is visited.

    ``depth_m``: the scene's distance; it scales steps of position to the effect of a rotation.
    """

    def __init__(self, cameras: Sequence[Camera], depth_m: float) -> None:
        self._cameras = list(cameras)
        self._depth_m = depth_m
        self.adam = PictureAdam("poses", np.zeros((len(self._cameras), 6)), EPSILON)

    def camera(self, view: int) -> Camera:
        """Return the corrected camera of a picture."""
        steps = self.adam.values
        return corrected(self._cameras[view], steps[view] - steps.mean(axis=0))

    def step(self, view: int, gradient: F64, progress: float) -> None:
        """Do one step of Adam; ``progress`` 0..1 lowers its rate."""
        scale = np.array([self._depth_m] * 3 + [1.0] * 3)
        scaled = gradient * scale  # of a displacement in units of the depth, as of a turn
        self.adam.step(view, scaled, self._rate_rad(view, progress) * scale)

    def corrections(self, names: Sequence[str]) -> list[PoseCorrection]:
        """Return how the pictures' poses were changed."""
        found = []
        for view, name in enumerate(names):
            before, after = self._cameras[view].world_from_cam, self.camera(view).world_from_cam
            between = before.inverse().compose(after)
            turned_deg = math.degrees(math.hypot(*rotation_vector(between.rotation)))
            found.append(PoseCorrection(name, math.hypot(*between.translation_m), turned_deg))
        return found

    def _rate_rad(self, view: int, progress: float) -> float:
        share = FALL + (1 - FALL) * 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
        return STEP_PX * share / self._cameras[view].intrinsics.fx_px


def align_pictures(
    field: SplatField, pictures: Sequence[PosedPicture], depth_m: float, threads: int
) -> list[PosedPicture]:
    """Return pictures with poses aligned with a field that is kept as it is, each by itself.

    A vehicle that finds its pose in the field does the same. It is for measuring a field with
    pictures whose poses are wrong.
    """
    antialiased = field.metadata.antialiased
    rasterizer = TrainableRasterizer(field.gaussians, threads=threads, antialiased=antialiased)
    aligned = []
    for picture in pictures:
        model = _Alone([picture.camera], depth_m)
        target = Target(picture.camera, picture.read(), mask=picture.read_mask())
        for number in range(ALIGN_STEPS):
            camera = model.camera(0)
            rasterizer.loss(target.colour_beside(rasterizer.forward(camera).colour))
            rasterizer.backward()
            centre_m = camera.world_from_cam.translation_m
            gradient = pose_gradient(field.gaussians, rasterizer.gradients(), centre_m)
            model.step(0, gradient, number / ALIGN_STEPS)
        aligned.append(replace(picture, camera=model.camera(0)))
    return aligned


class _Alone(PoseModel):
    """The camera of one picture, which may go anywhere."""

    def camera(self, view: int) -> Camera:
        """Return the corrected camera."""
        return corrected(self._cameras[view], self.adam.values[view])
