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

A key of our own, ``anchor``, states where on the Earth that world is (``rfcore.geodesy``).
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
    POSE_SHAPES,
    anchor_at,
    blamed_on,
    lens_of,
    load_json,
    pose_of_rows,
    table_at,
)
from rfcore.dataset.picture_file import check_size, find_picture, inside, picture_file, read_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints, read_points
from rfcore.errors import DatasetError
from rfcore.tables import Range, Table

UNREAD_LENSES = ("ftheta_p0", "is_equirectangular", "is_latlong")
"""instant-ngp's lenses that are not read here."""


@dataclass(frozen=True)
class AppliedTransform:
    """A transform that was applied to the original world: ``file = scale (transform original)``."""

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
    top = table_at(str(file), content)
    frames = top.items("frames")
    if not frames:
        raise top.error("frames", "must list at least one frame")
    applied = _applied(str(file), top)
    kept = [(i, frame) for i, frame in enumerate(frames) if not _sorted_out(file, i, frame)]
    pictures = tuple(_picture(file, content, i, frame) for i, frame in kept)
    points = _points(file, top)
    if applied is not None:
        pictures = tuple(
            replace(picture, world_from_cam=applied.undo(picture.world_from_cam))
            for picture in pictures
        )
        points = applied.undo_points(points) if points is not None else None
    missing = len(frames) - len(kept)
    exposure_varies = top.choice("exposure", ("auto", "fixed"), "fixed") == "auto"
    anchor = anchor_at(str(file), content.get("anchor"))
    return Source(file, pictures, points, missing, exposure_varies, anchor)


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
    return picture_file(where, file.parent, table_at(where, frame).text("file_path")) is None


def _picture(file: Path, content: dict[str, Any], index: int, frame: Any) -> SourcePicture:
    where = f"{file}: frames[{index}]"
    name = table_at(where, frame).text("file_path")
    where = f"{where} ({name})"
    keys = table_at(where, frame)
    camera = _camera(where, table_at(where, ChainMap(frame, content)))
    rows = keys.matrix("transform_matrix", POSE_SHAPES)
    path = find_picture(where, file.parent, name)
    check_size(path, camera.intrinsics)
    opencv_rows = [[r[0], -r[1], -r[2], r[3]] for r in rows]
    return SourcePicture(
        where=where,
        name=name,
        camera=camera,
        world_from_cam=pose_of_rows(where, "transform_matrix", opencv_rows),
        read=partial(read_picture, path, camera.intrinsics),
        time_ns=round(keys.number("time", Range(0.0)) * 1e9) if "time" in keys else None,
    )


def _camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = keys.whole("w"), keys.whole("h")
    fx_px = _focal(keys, "fl_x", "camera_angle_x", width_px)
    has_fy = "fl_y" in keys or "camera_angle_y" in keys
    with blamed_on(where):
        intrinsics = Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=fx_px,
            fy_px=_focal(keys, "fl_y", "camera_angle_y", height_px) if has_fy else fx_px,
            cx_px=keys.number("cx", default=width_px / 2),
            cy_px=keys.number("cy", default=height_px / 2),
        )
    return SourceCamera(intrinsics, lens_of(where, _model(keys), keys))


def _model(keys: Table) -> object:
    for key in UNREAD_LENSES:
        if keys.value(key, None):
            raise keys.error(key, "names a lens that is not read here")
    if keys.value("is_fisheye", None):
        return "OPENCV_FISHEYE"
    return keys.value("camera_model", "OPENCV")


def _focal(keys: Table, key: str, angle_key: str, side: int) -> float:
    """Return a focal length in pixels, stated or as the full field of view in radians."""
    if key in keys or angle_key not in keys:
        return keys.number(key)
    angle_rad = keys.number(angle_key)
    if not 0 < angle_rad < math.pi:
        raise keys.error(angle_key, f"is {angle_rad} rad, outside 0..pi")
    return 0.5 * side / math.tan(0.5 * angle_rad)


def _applied(where: str, content: Table) -> AppliedTransform | None:
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    turned_from_original = Pose.identity()
    if "applied_transform" in content:
        rows = content.matrix("applied_transform", POSE_SHAPES)
        turned_from_original = pose_of_rows(where, "applied_transform", rows)
    scale = content.number("applied_scale", default=1.0)
    if scale <= 0:
        raise content.error("applied_scale", f"is {scale}, must be above 0")
    return AppliedTransform(turned_from_original.inverse(), scale)


def _points(file: Path, content: Table) -> SourcePoints | None:
    if content.value("ply_file_path", None) is None:
        return None
    return read_points(inside(str(file), file.parent, content.text("ply_file_path")))
