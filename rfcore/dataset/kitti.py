"""A KITTI odometry sequence: ``calib.txt``, ``times.txt``, ``image_2`` and the poses.

As its devkit's readme defines them: ``P2`` is the 3x4 projection of the left colour camera from the
rectified frame of the left grey camera (camera 0), ``K [I | t]``; a pose line is world_from_cam0,
3x4, rows first; axes are OpenCV's (x right, y down, z forward). Poses are taken from ``poses.txt``
in the sequence or from ``../../poses/<sequence>.txt``, as the data set is laid out.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import finite_numbers, pose_of_rows, text_lines
from rfcore.dataset.picture_file import check_size, picture_size_px, read_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.dataset.trajectory import time_ns
from rfcore.errors import DatasetError, InvalidInput

__all__ = ["read_kitti_source"]


def read_kitti_source(folder: Path) -> Source:
    """Read a sequence's folder. Raises ``DatasetError`` naming the file and the line."""
    paths = sorted(folder.glob("image_2/*.png")) + sorted(folder.glob("image_2/*.jpg"))
    if not paths:
        raise DatasetError(f"{folder / 'image_2'}: holds no pictures (.png, .jpg)")
    camera, cam0_from_cam2 = _camera(folder / "calib.txt", paths[0])
    times_ns = _times_ns(folder / "times.txt", len(paths))
    poses = _poses(_poses_file(folder), len(paths))
    pictures = []
    for path, time, (where, world_from_cam0) in zip(paths, times_ns, poses, strict=True):
        check_size(path, camera.intrinsics)
        pictures.append(
            SourcePicture(
                where=where,
                name=path.name,
                camera=camera,
                world_from_cam=world_from_cam0.compose(cam0_from_cam2),
                read=partial(read_picture, path, camera.intrinsics),
                time_ns=time,
            )
        )
    return Source(folder / "calib.txt", tuple(pictures))


def _camera(file: Path, first: Path) -> tuple[SourceCamera, Pose]:
    """Return the colour camera and where it stands in camera 0's frame."""
    where, p = _projection(file)
    size_px = picture_size_px(first)
    if size_px is None:
        raise DatasetError(f"{first}: not a PNG or JPEG picture")
    (fx_px, _, cx_px, a), (_, fy_px, cy_px, b), (_, _, _, c) = p
    try:
        intrinsics = Intrinsics(*size_px, fx_px, fy_px, cx_px, cy_px)
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error
    shift = ((a - cx_px * c) / fx_px, (b - cy_px * c) / fy_px, c)
    cam2_from_cam0 = Pose(shift, Pose.identity().rotation)
    return SourceCamera(intrinsics), cam2_from_cam0.inverse()


def _projection(file: Path) -> tuple[str, tuple[list[float], ...]]:
    for i, line in enumerate(text_lines(file), start=1):
        key, _, rest = line.partition(":")
        if key.strip() == "P2":
            where = f"{file}: line {i} (P2)"
            p = _rows(where, rest)
            if p[0][1] or p[1][0] or p[2][:3] != [0.0, 0.0, 1.0]:
                raise DatasetError(f"{where}: is not K [I | t] of a rectified camera")
            return where, p
    raise DatasetError(f"{file}: has no line 'P2:'")


def _rows(where: str, line: str) -> tuple[list[float], ...]:
    values = finite_numbers(where, line.split())
    if len(values) != 12:
        raise DatasetError(f"{where}: has {len(values)} numbers, a 3x4 matrix has 12")
    return (values[:4], values[4:8], values[8:])


def _times_ns(file: Path, count: int) -> list[int]:
    rows = [(i, line) for i, line in enumerate(text_lines(file), start=1) if line.strip()]
    _check_count(file, "times", len(rows), count)
    return [time_ns(f"{file}: line {i}", line.strip()) for i, line in rows]


def _poses_file(folder: Path) -> Path:
    own = folder / "poses.txt"
    sequence = folder.absolute()
    shared = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    if not own.is_file() and not shared.is_file():
        raise DatasetError(f"{folder}: has no poses.txt, and {shared} does not exist")
    return own if own.is_file() else shared


def _poses(file: Path, count: int) -> list[tuple[str, Pose]]:
    rows = [(i, line) for i, line in enumerate(text_lines(file), start=1) if line.strip()]
    _check_count(file, "poses", len(rows), count)
    places = [(f"{file}: line {i}", line) for i, line in rows]
    return [(where, pose_of_rows(where, "pose", _rows(where, line))) for where, line in places]


def _check_count(file: Path, what: str, found: int, pictures: int) -> None:
    if found != pictures:
        raise DatasetError(f"{file}: holds {found} {what} for {pictures} pictures in image_2")
