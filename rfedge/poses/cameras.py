"""Cameras and poses between this project and COLMAP: the same axes, the same pixel centres."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rfcore.camera import Pose
from rfcore.dataset.colmap_model import camera_of
from rfcore.dataset.source import SourceCamera
from rfcore.lens import BrownLens, FisheyeLens

if TYPE_CHECKING:
    import pycolmap

__all__ = ["camera_parameters", "pose_from_colmap", "rigid_of", "source_camera"]


def camera_parameters(camera: SourceCamera) -> tuple[str, list[float]]:
    """Return COLMAP's name of the camera's model and its parameters."""
    k, lens = camera.intrinsics, camera.lens
    pinhole = [k.fx_px, k.fy_px, k.cx_px, k.cy_px]
    if isinstance(lens, FisheyeLens):
        return "OPENCV_FISHEYE", [*pinhole, lens.k1, lens.k2, lens.k3, lens.k4]
    if isinstance(lens, BrownLens):
        brown = [*pinhole, lens.k1, lens.k2, lens.p1, lens.p2]
        return ("FULL_OPENCV", [*brown, lens.k3, 0, 0, 0]) if lens.k3 else ("OPENCV", brown)
    return "PINHOLE", pinhole


def source_camera(camera: pycolmap.Camera) -> SourceCamera:
    """Return a camera that COLMAP estimated."""
    size_px = (camera.width, camera.height)
    return camera_of("estimated camera", camera.model.name, size_px, list(camera.params))


def rigid_of(world_from_cam: Pose) -> pycolmap.Rigid3d:
    """Return COLMAP's cam_from_world; its quaternions are x, y, z, w."""
    import pycolmap

    pose = world_from_cam.inverse()
    w, x, y, z = pose.rotation
    rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
    return pycolmap.Rigid3d(rotation, np.array(pose.translation_m))


def pose_from_colmap(cam_from_world: pycolmap.Rigid3d) -> Pose:
    """Return world_from_cam."""
    return Pose.from_matrix(cam_from_world.matrix().tolist()).inverse()
