"""Posed pictures from a ``transforms.json`` of nerfstudio or instant-ngp.

``transform_matrix`` is world_from_camera with OpenGL camera axes (x right, y up, z backward);
it becomes OpenCV axes here. Intrinsics stand at the top and may be overridden per frame; where
``fl_y``, ``cx`` or ``cy`` are left out they are ``fl_x`` and the middle of the picture, as both
programs define it. ``time`` is in seconds. Other keys are ignored, except distortion.
"""

from __future__ import annotations

import json
import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.dataset.points import read_points
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import Rgb, read_rgb
from rfcore.views import PointCloud, PosedPicture

__all__ = ["Dataset", "read_transforms"]

PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
MAX_TILE_RADIUS_M = 100_000.0
"""float32 positions resolve 8 mm at this distance from the tile's origin."""

Json = Mapping[str, Any]


@dataclass(frozen=True)
class Dataset:
    """Posed pictures on disk, in the order of the file.

    ``rate_hz`` is the mean rate of the pictures' times, ``None`` unless every picture has one and
    they increase. ``points`` is ``None`` when the file names none.
    """

    pictures: tuple[PosedPicture, ...]
    rate_hz: float | None
    points: PointCloud | None
    tile_origin: TileOrigin


def read_transforms(path: Path, tile_origin: TileOrigin | None = None) -> Dataset:
    """Read a transforms file, or the only one of a directory.

    Poses and points come out relative to ``tile_origin`` (zero when not given). Pixels are read
    on demand. Raises ``DatasetError`` naming the file, the key and the value at fault.
    """
    origin = tile_origin if tile_origin is not None else TileOrigin()
    file = _transforms_file(path)
    content = _load(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DatasetError(f"{file}: key 'frames' must list at least one frame")
    pictures = tuple(_picture(file, content, i, frame, origin) for i, frame in enumerate(frames))
    timed = all("time" in frame for frame in frames)
    return Dataset(
        pictures=pictures,
        rate_hz=_rate_hz([picture.time_ns for picture in pictures]) if timed else None,
        points=_points(file, content, origin),
        tile_origin=origin,
    )


def _transforms_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob("transforms*.json"))
    plain = path / "transforms.json"
    if plain in found or len(found) == 1:
        return plain if plain in found else found[0]
    names = ", ".join(file.name for file in found) or "none"
    raise DatasetError(
        f"{path}: has no transforms.json; name one of its transforms files ({names})"
    )


def _load(file: Path) -> Json:
    try:
        content = json.loads(file.read_bytes())
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DatasetError(f"{file}: not JSON ({error})") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{file}: holds {type(content).__name__}, not an object with 'frames'")
    return content


def _picture(file: Path, content: Json, index: int, frame: Any, origin: TileOrigin) -> PosedPicture:
    where = f"{file}: frames[{index}]"
    if not isinstance(frame, dict):
        raise DatasetError(f"{where}: is {frame!r}, not an object")
    name = frame.get("file_path")
    if not isinstance(name, str):
        raise DatasetError(f"{where}: key 'file_path' is missing or not a string")
    where = f"{where} ({name})"
    intrinsics = _intrinsics(where, ChainMap(frame, dict(content)))
    pose = _world_from_cam(where, frame.get("transform_matrix"), origin)
    return PosedPicture(
        name=name,
        camera=Camera(intrinsics, pose),
        read=partial(_read_picture, _picture_file(where, file.parent / name), intrinsics),
        time_ns=round(_number(where, frame, "time", minimum=0.0) * 1e9) if "time" in frame else 0,
    )


def _picture_file(where: str, path: Path) -> Path:
    """Return the file; a name without suffix means PNG, as in the NeRF synthetic data."""
    candidate = path if path.suffix else path.with_suffix(".png")
    if not candidate.is_file():
        raise DatasetError(f"{where}: picture {candidate} is missing")
    return candidate


def _read_picture(path: Path, intrinsics: Intrinsics) -> Rgb:
    rgb = read_rgb(path)
    height, width = rgb.shape[:2]
    if (width, height) != (intrinsics.width_px, intrinsics.height_px):
        raise DatasetError(
            f"{path}: picture is {width}x{height} px, its camera says "
            f"{intrinsics.width_px}x{intrinsics.height_px}"
        )
    return rgb


def _intrinsics(where: str, keys: Json) -> Intrinsics:
    _check_undistorted(where, keys)
    width_px, height_px = _side(where, keys, "w"), _side(where, keys, "h")
    fx_px = _focal(where, keys, "fl_x", "camera_angle_x", width_px)
    has_fy = "fl_y" in keys or "camera_angle_y" in keys
    try:
        return Intrinsics(
            width_px=width_px,
            height_px=height_px,
            fx_px=fx_px,
            fy_px=_focal(where, keys, "fl_y", "camera_angle_y", height_px) if has_fy else fx_px,
            cx_px=_number(where, keys, "cx") if "cx" in keys else width_px / 2,
            cy_px=_number(where, keys, "cy") if "cy" in keys else height_px / 2,
        )
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error


def _check_undistorted(where: str, keys: Json) -> None:
    model = keys.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise DatasetError(
            f"{where}: camera_model {model!r} is none of {', '.join(PINHOLE_MODELS)}; "
            "undistort the pictures first"
        )
    for key in DISTORTION_KEYS:
        if key in keys and _number(where, keys, key) != 0.0:
            raise DatasetError(
                f"{where}: lens distortion {key} = {keys[key]} is not supported yet; "
                "undistort the pictures first"
            )


def _side(where: str, keys: Json, key: str) -> int:
    value = _number(where, keys, key)
    if value != int(value):
        raise DatasetError(f"{where}: key '{key}' is {value}, not a whole number of pixels")
    return int(value)


def _focal(where: str, keys: Json, key: str, angle_key: str, side_px: int) -> float:
    """Return a focal length in pixels, stated or as the full field of view in radians."""
    if key in keys or angle_key not in keys:
        return _number(where, keys, key)
    angle_rad = _number(where, keys, angle_key)
    if not 0 < angle_rad < math.pi:
        raise DatasetError(f"{where}: {angle_key} = {angle_rad} rad is outside 0..pi")
    return 0.5 * side_px / math.tan(0.5 * angle_rad)


def _number(where: str, keys: Json, key: str, minimum: float = -math.inf) -> float:
    if key not in keys:
        raise DatasetError(f"{where}: key '{key}' is missing")
    value = keys[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DatasetError(f"{where}: key '{key}' is {value!r}, not a number")
    if not math.isfinite(value):
        raise DatasetError(f"{where}: key '{key}' is {value}, must be finite")
    if value < minimum:
        raise DatasetError(f"{where}: key '{key}' is {value}, must be at least {minimum:g}")
    return float(value)


def _world_from_cam(where: str, matrix: Any, origin: TileOrigin) -> Pose:
    """Return the OpenCV pose of an OpenGL camera: y and z change sign."""
    rows = _matrix_rows(where, matrix)
    try:
        pose = Pose.from_matrix([[r[0], -r[1], -r[2], r[3]] for r in rows])
    except InvalidInput as error:
        raise DatasetError(f"{where}: transform_matrix: {error}") from error
    local = origin.localise(pose)
    distance_m = math.hypot(*local.translation_m)
    if distance_m > MAX_TILE_RADIUS_M:
        raise DatasetError(
            f"{where}: camera is {distance_m:.6g} m from the tile's origin, over "
            f"{MAX_TILE_RADIUS_M:g} m; pass a tile_origin near the pictures"
        )
    return local


def _matrix_rows(where: str, matrix: Any) -> list[Sequence[float]]:
    shaped = isinstance(matrix, list) and len(matrix) in (3, 4)
    if not shaped or any(not isinstance(row, list) or len(row) != 4 for row in matrix):
        raise DatasetError(f"{where}: key 'transform_matrix' is missing or not 4x4")
    for i, row in enumerate(matrix):
        for j, value in enumerate(row):
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise DatasetError(
                    f"{where}: transform_matrix[{i}][{j}] is {value!r}, not a finite number"
                )
    return list(matrix)


def _rate_hz(times_ns: Sequence[int]) -> float | None:
    if len(times_ns) < 2 or any(b <= a for a, b in pairwise(times_ns)):
        return None
    return (len(times_ns) - 1) * 1e9 / (times_ns[-1] - times_ns[0])


def _points(file: Path, content: Json, origin: TileOrigin) -> PointCloud | None:
    name = content.get("ply_file_path")
    if name is None:
        return None
    if not isinstance(name, str):
        raise DatasetError(f"{file}: key 'ply_file_path' is {name!r}, not a string")
    return read_points(file.parent / name, origin)
