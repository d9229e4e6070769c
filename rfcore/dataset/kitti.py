"""KITTI: an odometry sequence, or a drive of the raw data, synchronised and rectified.

A sequence is ``calib.txt``, ``times.txt``, ``image_2`` and the poses. As its devkit's readme
defines them: ``P2`` is the 3x4 projection of the left colour camera from the rectified frame of the
left grey camera (camera 0), ``K [I | t]``; a pose line is world_from_cam0, 3x4, rows first; axes
are OpenCV's (x right, y down, z forward). Poses are taken from ``poses.txt`` in the sequence or
from ``../../poses/<sequence>.txt``, as the data set is laid out.

A raw drive (Geiger et al., IJRR 2013), ``DATE/DATE_drive_NNNN_sync``, has ``image_02/data`` and
``oxts/data``, a file of 30 numbers each, and beside it ``calib_imu_to_velo.txt``,
``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt``. Of the numbers the first six are latitude
and longitude (degrees, WGS 84), altitude (m), roll, pitch and yaw (rad) of the IMU, whose axes are
forward, left and up; yaw is 0 to the east, anticlockwise. With Rx, Ry, Rz turns about x, y, z::

    world_from_imu = [Rz(yaw) Ry(pitch) Rx(roll) | ENU of the first IMU position]
    world_from_cam2 = world_from_imu imu_from_velo velo_from_cam0 inverse(R_rect_00) cam0_from_cam2

with the last from ``P_rect_02`` as from ``P2`` above. The world is the tangent plane at the first
position (east, north, up), of which the dataset says where on the Earth it is
(``rfcore.geodesy``, extra ``localise``); that the horizon turns by 0.01 degrees a kilometre is left
out. The devkit projects by Mercator on a sphere instead: there, 0.2 % shorter to the east and 0.1 %
longer to the north.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import (
    blamed_on,
    filled_lines,
    finite_numbers,
    pose_of_rows,
    text_lines,
)
from rfcore.dataset.picture_file import PictureFile
from rfcore.dataset.picture_header import picture_header
from rfcore.dataset.source import Source, SourceCamera, SourcePicture
from rfcore.dataset.trajectory import time_ns
from rfcore.errors import DatasetError
from rfcore.geodesy import Anchor

OXTS = "oxts"
"""The folder by which a raw drive is recognised."""
OXTS_NUMBERS = 30

Row3 = tuple[float, float, float]


def read_kitti_source(folder: Path) -> Source:
    """Read a sequence's folder. Raises ``DatasetError`` naming the file and the line."""
    paths = _picture_paths(folder / "image_2")
    camera, cam0_from_cam2 = _camera(folder / "calib.txt", "P2", paths[0])
    times_ns = _times_ns(folder / "times.txt", paths, time_ns)
    poses = _poses(_poses_file(folder), paths)
    posed = [(where, pose.compose(cam0_from_cam2)) for where, pose in poses]
    return Source(folder / "calib.txt", _pictures(paths, times_ns, posed, camera))


def read_kitti_raw_source(folder: Path) -> Source:
    """Read the left colour camera of a raw drive's folder.

    Raises ``DatasetError`` naming the file and the line.
    """
    paths = _picture_paths(folder / "image_02" / "data")
    calibration = folder.absolute().parent
    camera, cam0_from_cam2 = _camera(calibration / "calib_cam_to_cam.txt", "P_rect_02", paths[0])
    times_ns = _times_ns(folder / "image_02" / "timestamps.txt", paths, _unix_ns)
    oxts = sorted((folder / OXTS / "data").glob("*.txt"))
    _check_count(folder / OXTS / "data", "files", len(oxts), paths)
    for file, path in zip(oxts, paths, strict=True):
        if file.stem != path.stem:
            raise DatasetError(f"{file}: is of no picture; {path.name} comes next there")
    rows = [_oxts_row(file) for file in oxts]
    with blamed_on(oxts[0]):
        anchor = Anchor(rows[0][0], rows[0][1], rows[0][2])
    imu_from_cam2 = _imu_from_cam0(calibration).compose(cam0_from_cam2)
    posed = [
        (str(file), _world_from_imu(file, row, anchor).compose(imu_from_cam2))
        for file, row in zip(oxts, rows, strict=True)
    ]
    pictures = _pictures(paths, times_ns, posed, camera)
    return Source(folder / OXTS, pictures, anchor=anchor)


def _picture_paths(folder: Path) -> list[Path]:
    paths = sorted(folder.glob("*.png")) + sorted(folder.glob("*.jpg"))
    if not paths:
        raise DatasetError(f"{folder}: holds no pictures (.png, .jpg)")
    return paths


def _pictures(
    paths: Sequence[Path],
    times_ns: Sequence[int],
    posed: Sequence[tuple[str, Pose]],
    camera: SourceCamera,
) -> tuple[SourcePicture, ...]:
    opened = [PictureFile.of(path, camera.intrinsics) for path in paths]
    return tuple(
        SourcePicture(
            where=where,
            name=picture.path.name,
            camera=camera,
            world_from_cam=world_from_cam,
            read=picture.read,
            time_ns=time,
            mask=picture.mask,
            notes=picture.notes,
        )
        for picture, time, (where, world_from_cam) in zip(opened, times_ns, posed, strict=True)
    )


def _camera(file: Path, key: str, first: Path) -> tuple[SourceCamera, Pose]:
    """Return the colour camera and where it stands in camera 0's frame."""
    where, rest = _line_of(file, key)
    p = _rows(where, rest)
    if p[0][1] or p[1][0] or p[2][:3] != [0.0, 0.0, 1.0]:
        raise DatasetError(f"{where}: is not K [I | t] of a rectified camera")
    size_px = picture_header(first).size_px
    (fx_px, _, cx_px, a), (_, fy_px, cy_px, b), (_, _, _, c) = p
    with blamed_on(where):
        intrinsics = Intrinsics(*size_px, fx_px, fy_px, cx_px, cy_px)
    shift = ((a - cx_px * c) / fx_px, (b - cy_px * c) / fy_px, c)
    cam2_from_cam0 = Pose(shift, Pose.identity().rotation)
    return SourceCamera(intrinsics), cam2_from_cam0.inverse()


def _line_of(file: Path, key: str) -> tuple[str, str]:
    """Return the place of the line that begins with ``key:``, and what follows."""
    for i, line in enumerate(text_lines(file), start=1):
        name, _, rest = line.partition(":")
        if name.strip() == key:
            return f"{file}: line {i} ({key})", rest
    raise DatasetError(f"{file}: has no line '{key}:'")


def _numbers(where: str, line: str, count: int, what: str) -> list[float]:
    values = finite_numbers(where, line.split())
    if len(values) != count:
        raise DatasetError(f"{where}: has {len(values)} numbers, {what} has {count}")
    return values


def _rows(where: str, line: str) -> tuple[list[float], ...]:
    values = _numbers(where, line, 12, "a 3x4 matrix")
    return (values[:4], values[4:8], values[8:])


def _times_ns(file: Path, paths: Sequence[Path], read: Callable[[str, str], int]) -> list[int]:
    lines = filled_lines(file)
    _check_count(file, "times", len(lines), paths)
    return [read(where, line.strip()) for where, line in lines]


def _poses_file(folder: Path) -> Path:
    own = folder / "poses.txt"
    sequence = folder.absolute()
    shared = sequence.parent.parent / "poses" / f"{sequence.name}.txt"
    if not own.is_file() and not shared.is_file():
        raise DatasetError(f"{folder}: has no poses.txt, and {shared} does not exist")
    return own if own.is_file() else shared


def _poses(file: Path, paths: Sequence[Path]) -> list[tuple[str, Pose]]:
    lines = filled_lines(file)
    _check_count(file, "poses", len(lines), paths)
    return [(where, pose_of_rows(where, "pose", _rows(where, line))) for where, line in lines]


def _check_count(file: Path, what: str, found: int, paths: Sequence[Path]) -> None:
    if found != len(paths):
        folder = paths[0].parent
        name = folder.parent.name if folder.name == "data" else folder.name
        raise DatasetError(f"{file}: holds {found} {what} for {len(paths)} pictures in {name}")


def _unix_ns(where: str, line: str) -> int:
    """Return a time as raw drives print it, ``2011-09-26 13:02:25.964389445``, taken for UTC."""
    whole, _, fraction = line.partition(".")
    try:
        seconds = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise DatasetError(f"{where}: '{line}' is not a time") from error
    if fraction and not (fraction.isdecimal() and fraction.isascii() and len(fraction) <= 9):
        raise DatasetError(f"{where}: '{line}' is not a time to nanoseconds")
    return time_ns(where, f"{int(seconds.timestamp())}.{fraction or 0}")


def _oxts_row(file: Path) -> list[float]:
    first = next(iter(text_lines(file)), "")
    return _numbers(str(file), first, OXTS_NUMBERS, "a line of OXTS")


def _world_from_imu(file: Path, row: Sequence[float], anchor: Anchor) -> Pose:
    with blamed_on(file):
        place = anchor.world_from_geodetic(*row[:3])
    turns = [[*axes, at] for axes, at in zip(_turns(*row[3:6]), place, strict=True)]
    return pose_of_rows(str(file), "roll, pitch, yaw", turns)


def _turns(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[Row3, Row3, Row3]:
    """Return Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle), math.sin(angle)) for angle in (roll_rad, pitch_rad, yaw_rad)
    )
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def _imu_from_cam0(calibration: Path) -> Pose:
    velo_from_imu = _rigid(calibration / "calib_imu_to_velo.txt")
    cam0_from_velo = _rigid(calibration / "calib_velo_to_cam.txt")
    where, rest = _line_of(calibration / "calib_cam_to_cam.txt", "R_rect_00")
    rectified = _matrix3(where, rest, (0.0, 0.0, 0.0))
    return rectified.compose(cam0_from_velo).compose(velo_from_imu).inverse()


def _rigid(file: Path) -> Pose:
    x, y, z = _numbers(*_line_of(file, "T"), 3, "a place")
    return _matrix3(*_line_of(file, "R"), (x, y, z))


def _matrix3(where: str, line: str, shift_m: Row3) -> Pose:
    values = _numbers(where, line, 9, "a 3x3 matrix")
    rows = [[*values[3 * i : 3 * i + 3], shift_m[i]] for i in range(3)]
    return pose_of_rows(where, "R", rows)
