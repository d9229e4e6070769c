"""Posed pictures from a ``transforms.json`` of nerfstudio or instant-ngp.

``transform_matrix`` is world_from_camera with OpenGL camera axes (x right, y up, z backward);
it becomes OpenCV axes here. Intrinsics, camera model and distortion stand at the top and may be
overridden per frame; where ``fl_y``, ``cx`` or ``cy`` are left out they are ``fl_x`` and the middle
of the picture, as both programs define it. ``time`` is in seconds. Other keys are ignored.
A frame with instant-ngp's ``sharpness`` whose picture is missing was sorted out as blurred and is
left out, as that program does; any other missing picture is an error.

nerfstudio's ``applied_transform`` A (a rotation and a shift) and ``applied_scale`` s say what was
done to the poses and points before the file was written, ``file = s (A original)``; it is undone,
so that the world is the one that was measured, in its metres.
"""

from __future__ import annotations

import math
from collections import ChainMap
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import (
    Table,
    lens_of,
    load_json,
    matrix_rows,
    number,
    pose_of_rows,
    side_px,
    text,
)
from rfcore.dataset.picture_file import check_size, find_picture, inside, picture_file, read_picture
from rfcore.dataset.points import read_points
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints
from rfcore.errors import DatasetError, InvalidInput

__all__ = ["read_transforms_source", "transforms_file"]

UNREAD_LENSES = ("ftheta_p0", "is_equirectangular", "is_latlong")
"""instant-ngp's lenses that are not read here."""


@dataclass(frozen=True)
class Applied:
    """What was applied to the original world: ``file = scale (transform original)``."""

    original_from_turned: Pose
    scale: float

    def undo(self, pose: Pose) -> Pose:
        """Return a pose of the file in the original world."""
        x, y, z = (value / self.scale for value in pose.translation_m)
        return self.original_from_turned.compose(Pose((x, y, z), pose.rotation))

    def undo_points(self, points: SourcePoints) -> SourcePoints:
        """Return points of the file in the original world."""
        pose = self.original_from_turned
        turned = points.xyz_m / self.scale @ np.array(pose.rotation_matrix()).T
        return SourcePoints(turned + pose.translation_m, points.rgb)


def read_transforms_source(file: Path) -> Source:
    """Read a transforms file. Raises ``DatasetError`` naming the file, the key and the value."""
    content = load_json(file)
    if not isinstance(content, dict):
        raise DatasetError(f"{file}: holds {type(content).__name__}, not an object with 'frames'")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DatasetError(f"{file}: key 'frames' must list at least one frame")
    applied = _applied(str(file), content)
    kept = [(i, frame) for i, frame in enumerate(frames) if not _sorted_out(file, i, frame)]
    pictures = tuple(_picture(file, content, i, frame) for i, frame in kept)
    points = _points(file, content)
    if applied is not None:
        pictures = tuple(_moved(picture, applied) for picture in pictures)
        points = applied.undo_points(points) if points is not None else None
    return Source(file, pictures, points, len(frames) - len(kept), _exposure_varies(file, content))


def transforms_file(folder: Path) -> Path | None:
    """Return a folder's transforms.json or its only transforms*.json, ``None`` without any."""
    found = sorted(folder.glob("transforms*.json"))
    plain = folder / "transforms.json"
    if plain in found:
        return plain
    if len(found) > 1:
        names = ", ".join(file.name for file in found)
        raise DatasetError(f"{folder}: name one of its transforms files ({names})")
    return found[0] if found else None


def _sorted_out(file: Path, index: int, frame: Any) -> bool:
    if not isinstance(frame, dict) or "sharpness" not in frame:
        return False
    where = f"{file}: frames[{index}]"
    return picture_file(where, file.parent, text(where, frame, "file_path")) is None


def _picture(file: Path, content: Table, index: int, frame: Any) -> SourcePicture:
    where = f"{file}: frames[{index}]"
    if not isinstance(frame, dict):
        raise DatasetError(f"{where}: is {frame!r}, not an object")
    name = text(where, frame, "file_path")
    where = f"{where} ({name})"
    camera = _camera(where, ChainMap(frame, dict(content)))
    rows = matrix_rows(where, frame, "transform_matrix")
    path = find_picture(where, file.parent, name)
    check_size(path, camera.intrinsics)
    opencv_rows = [[r[0], -r[1], -r[2], r[3]] for r in rows]
    return SourcePicture(
        where=where,
        name=name,
        camera=camera,
        world_from_cam=pose_of_rows(where, "transform_matrix", opencv_rows),
        read=partial(read_picture, path, camera.intrinsics),
        time_ns=round(number(where, frame, "time", minimum=0.0) * 1e9) if "time" in frame else None,
    )


def _camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = side_px(where, keys, "w"), side_px(where, keys, "h")
    fx_px = _focal(where, keys, "fl_x", "camera_angle_x", width_px)
    has_fy = "fl_y" in keys or "camera_angle_y" in keys
    try:
        intrinsics = Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=fx_px,
            fy_px=_focal(where, keys, "fl_y", "camera_angle_y", height_px) if has_fy else fx_px,
            cx_px=number(where, keys, "cx") if "cx" in keys else width_px / 2,
            cy_px=number(where, keys, "cy") if "cy" in keys else height_px / 2,
        )
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error
    return SourceCamera(intrinsics, lens_of(where, _model(where, keys), keys))


def _model(where: str, keys: Table) -> object:
    for key in UNREAD_LENSES:
        if keys.get(key):
            raise DatasetError(f"{where}: key '{key}' names a lens that is not read here")
    if keys.get("is_fisheye"):
        return "OPENCV_FISHEYE"
    return keys.get("camera_model", "OPENCV")


def _focal(where: str, keys: Table, key: str, angle_key: str, side: int) -> float:
    """Return a focal length in pixels, stated or as the full field of view in radians."""
    if key in keys or angle_key not in keys:
        return number(where, keys, key)
    angle_rad = number(where, keys, angle_key)
    if not 0 < angle_rad < math.pi:
        raise DatasetError(f"{where}: {angle_key} = {angle_rad} rad is outside 0..pi")
    return 0.5 * side / math.tan(0.5 * angle_rad)


def _applied(where: str, content: Table) -> Applied | None:
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    turned_from_original = Pose.identity()
    if "applied_transform" in content:
        rows = matrix_rows(where, content, "applied_transform")
        turned_from_original = pose_of_rows(where, "applied_transform", rows)
    scale = number(where, content, "applied_scale") if "applied_scale" in content else 1.0
    if scale <= 0:
        raise DatasetError(f"{where}: key 'applied_scale' is {scale}, must be above 0")
    return Applied(turned_from_original.inverse(), scale)


def _moved(picture: SourcePicture, applied: Applied) -> SourcePicture:
    return replace(picture, world_from_cam=applied.undo(picture.world_from_cam))


def _exposure_varies(file: Path, content: Table) -> bool:
    value = content.get("exposure", "fixed")
    if value not in ("auto", "fixed"):
        raise DatasetError(f"{file}: key 'exposure' is {value!r}, neither 'auto' nor 'fixed'")
    return bool(value == "auto")


def _points(file: Path, content: Table) -> SourcePoints | None:
    if content.get("ply_file_path") is None:
        return None
    return read_points(inside(str(file), file.parent, text(str(file), content, "ply_file_path")))
