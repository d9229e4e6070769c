"""A COLMAP model as tables: cameras, posed images, points.

Poses are cam_from_world with OpenCV camera axes, quaternions w, x, y, z; pixel centres are at +0.5
as here. Described in COLMAP's documentation, "Output Format"; the parsers of its two encodings are
``rfcore.dataset.colmap_text`` and ``rfcore.dataset.colmap_binary``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import pose_of_quaternion, shortened
from rfcore.dataset.lens_keys import LENS_KEYS, lens_of
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.errors import DatasetError, InvalidInput

__all__ = ["MODEL_IDS", "ColmapImage", "ColmapModel", "camera_of", "image_of", "parameter_count"]

MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
}
MAX_NAME = 60
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
COLMAP_LENS_KEYS = {**LENS_KEYS, "OPENCV": ("k1", "k2", "p1", "p2")}


@dataclass(frozen=True)
class ColmapImage:
    """One registered image; ``where`` is its place in the file."""

    where: str
    name: str
    camera_id: int
    cam_from_world: Pose


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by id, images in the order of the file, points if there are any."""

    cameras: dict[int, SourceCamera]
    images: tuple[ColmapImage, ...]
    points: SourcePoints | None


def parameter_count(where: str, model: object) -> int:
    """Return how many parameters a camera model has; ``DatasetError`` for an unknown one."""
    if not isinstance(model, str) or model not in COLMAP_LENS_KEYS:
        raise DatasetError(f"{where}: camera model {model} is none of {', '.join(LENS_KEYS)}")
    return (3 if model in ONE_FOCAL else 4) + len(COLMAP_LENS_KEYS[model])


def camera_of(
    where: str, model: str, size_px: tuple[int, int], parameters: Sequence[float]
) -> SourceCamera:
    """Return a camera from its parameters, which are f or fx, fy, then cx, cy, then the lens."""
    needed = parameter_count(where, model)
    if len(parameters) != needed:
        raise DatasetError(f"{where}: {model} has {needed} parameters, not {len(parameters)}")
    focal = 1 if model in ONE_FOCAL else 2
    fx_px, fy_px = parameters[0], parameters[focal - 1]
    cx_px, cy_px = parameters[focal : focal + 2]
    lens = dict(zip(COLMAP_LENS_KEYS[model], parameters[focal + 2 :], strict=True))
    try:
        intrinsics = Intrinsics(*size_px, fx_px, fy_px, cx_px, cy_px)
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error
    return SourceCamera(intrinsics, lens_of(where, model, lens))


def image_of(where: str, name: str, camera_id: int, numbers: Sequence[float]) -> ColmapImage:
    """Return an image from qw, qx, qy, qz, tx, ty, tz."""
    if not name.isprintable() or not name:
        raise DatasetError(f"{where}: name {shortened(name)} is empty or not printable")
    where = f"{where} ({name[:MAX_NAME]})"
    pose = pose_of_quaternion(where, numbers[4:7], numbers[:4])
    return ColmapImage(where, name, camera_id, pose)
