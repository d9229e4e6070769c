"""Writing a dataset as ``transforms.json`` (nerfstudio) with pictures and points beside it.

Poses are written in the dataset's own world, float64, with OpenGL camera axes; what
``rfcore.dataset.read`` reads back is what was given.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.field.ply_table import write_vertices
from rfcore.files import write_whole
from rfcore.geodesy import Anchor, anchor_values
from rfcore.lens import FisheyeLens

POINTS_NAME = "points.ply"
COLUMNS = [(n, "<f8") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]


@dataclass(frozen=True)
class WrittenPicture:
    """A picture that already lies in the folder, by its path there."""

    file_path: str
    camera: SourceCamera
    world_from_cam: Pose
    time_ns: int | None = None
    mask_path: str | None = None


def write_transforms(
    folder: Path,
    pictures: Sequence[WrittenPicture],
    points: SourcePoints | None,
    anchor: Anchor | None = None,
) -> None:
    """Write ``points.ply``, if there are points, and then ``transforms.json``.

    ``anchor`` is of the dataset's own world.
    """
    if points is not None:
        write_points(folder / POINTS_NAME, points)
    content = transforms_of(pictures, POINTS_NAME if points is not None else None)
    if anchor is not None:
        content = {"anchor": anchor_values(anchor), **content}
    write_whole(folder / "transforms.json", json.dumps(content, indent=1) + "\n")


def transforms_of(pictures: Sequence[WrittenPicture], points_name: str | None) -> dict[str, Any]:
    """Return the content of a ``transforms.json``; a camera that all share stands at the top."""
    cameras = {picture.camera for picture in pictures}
    shared = _camera_keys(pictures[0].camera) if len(cameras) == 1 else {}
    content: dict[str, Any] = dict(shared)
    if points_name is not None:
        content["ply_file_path"] = points_name
    content["frames"] = [_frame(picture, not shared) for picture in pictures]
    return content


def _frame(picture: WrittenPicture, own_camera: bool) -> dict[str, Any]:
    frame: dict[str, Any] = {"file_path": picture.file_path}
    if picture.mask_path is not None:
        frame["mask_path"] = picture.mask_path
    if picture.time_ns is not None:
        frame["time"] = picture.time_ns / 1e9
    if own_camera:
        frame |= _camera_keys(picture.camera)
    rotation = picture.world_from_cam.rotation_matrix()
    rows = [
        [r[0], -r[1], -r[2], t]
        for r, t in zip(rotation, picture.world_from_cam.translation_m, strict=True)
    ]
    return frame | {"transform_matrix": [*rows, [0.0, 0.0, 0.0, 1.0]]}


def _camera_keys(camera: SourceCamera) -> dict[str, Any]:
    lens = {} if camera.lens is None else asdict(camera.lens)  # type: ignore[call-overload]
    if isinstance(camera.lens, FisheyeLens):
        model = "OPENCV_FISHEYE"
    else:  # OPENCV of nerfstudio has a k4 of its own
        model = "FULL_OPENCV" if any(lens.get(key) for key in ("k4", "k5", "k6")) else "OPENCV"
    return {"camera_model": model, **_intrinsics_keys(camera.intrinsics), **lens}


def _intrinsics_keys(k: Intrinsics) -> dict[str, float]:
    return {
        "w": k.width_px,
        "h": k.height_px,
        "fl_x": k.fx_px,
        "fl_y": k.fy_px,
        "cx": k.cx_px,
        "cy": k.cy_px,
    }


def write_points(file: Path, points: SourcePoints) -> None:
    """Write coloured points as PLY, positions as float64."""
    table = np.empty(len(points.xyz_m), COLUMNS)
    for i, axis in enumerate("xyz"):
        table[axis] = points.xyz_m[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        table[name] = points.rgb[:, i]
    write_vertices(file, table)
