"""Posed pictures from the ``cameras.json`` of the INRIA 3D Gaussian Splatting code.

Each entry has ``img_name``, ``width``, ``height``, ``fx``, ``fy`` in pixels, ``position`` in the
world and ``rotation``, the rows of world_from_cam with OpenCV camera axes; the principal point is
the middle. The pictures are expected in ``images`` beside the file. ``input.ply`` beside it holds
the points training started from, ``point_cloud/iteration_N/point_cloud.ply`` the trained Gaussians.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from rfcore.camera import Intrinsics
from rfcore.dataset.keys import load_json, pose_of_rows, table_at
from rfcore.dataset.picture_file import check_size, find_picture, read_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, read_points
from rfcore.errors import DatasetError, InvalidInput
from rfcore.tables import Table

__all__ = ["read_inria_source", "trained_ply"]


def read_inria_source(file: Path) -> Source:
    """Read a ``cameras.json``. Raises ``DatasetError`` naming the file, the entry and the key."""
    entries = load_json(file)
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{file}: must be a list of at least one camera")
    pictures = tuple(_picture(file, i, entry) for i, entry in enumerate(entries))
    points = file.parent / "input.ply"
    return Source(file, pictures, read_points(points) if points.is_file() else None)


def trained_ply(folder: Path) -> Path:
    """Return the trained Gaussians of the last iteration that a training folder holds."""
    found = folder.glob("point_cloud/iteration_*/point_cloud.ply")
    numbered = [(path.parent.name.rpartition("_")[2], path) for path in found]
    iterations = [(int(digits), path) for digits, path in numbered if digits.isdecimal()]
    if not iterations:
        raise DatasetError(f"{folder}: no point_cloud/iteration_N/point_cloud.ply")
    return max(iterations)[1]


def _picture(file: Path, index: int, entry: Any) -> SourcePicture:
    where = f"{file}: [{index}]"
    name = table_at(where, entry).text("img_name")
    where = f"{where} ({name})"
    keys = table_at(where, entry)
    camera = _camera(where, keys)
    position = keys.numbers("position", 3)
    rotation = keys.matrix("rotation", ((3, 3),))
    rows = [[*row, t] for row, t in zip(rotation, position, strict=True)]
    path = find_picture(where, file.parent / "images", name)
    check_size(path, camera.intrinsics)
    return SourcePicture(
        where=where,
        name=name,
        camera=camera,
        world_from_cam=pose_of_rows(where, "rotation", rows),
        read=partial(read_picture, path, camera.intrinsics),
    )


def _camera(where: str, keys: Table) -> SourceCamera:
    width_px, height_px = keys.whole("width"), keys.whole("height")
    try:
        intrinsics = Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=keys.number("fx"),
            fy_px=keys.number("fy"),
            cx_px=width_px / 2,
            cy_px=height_px / 2,
        )
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error
    return SourceCamera(intrinsics)
