"""Values of a JSON or TOML table or of a line of text, checked one by one.

``where`` is the file and the place in it; every error starts with it and names the key.

The lens of a camera as tables name it: a camera model and coefficients k1, k2, p1, ...

Models are COLMAP's names, which nerfstudio shares. Coefficients of zero are no lens,
except of a fisheye, which is one even then. A coefficient that the model does not have, and a model
that is not known, raise ``DatasetError``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rfcore.camera import Pose
from rfcore.errors import DatasetError, InvalidInput
from rfcore.lens import BrownLens, FisheyeLens, Lens

__all__ = [
    "LENS_KEYS",
    "Table",
    "finite_numbers",
    "lens_of",
    "load_json",
    "matrix_rows",
    "number",
    "pose_of_quaternion",
    "pose_of_rows",
    "read_file",
    "shortened",
    "side_px",
    "text",
    "text_lines",
]


FILE_NORM_TOLERANCE = 1e-3
"""Trajectories are printed with as few as four decimals."""
MAX_SHOWN = 60
Table = Mapping[str, Any]


def read_file(file: Path) -> bytes:
    """Return a file's bytes; raise ``DatasetError`` naming it."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from error


def load_json(file: Path) -> Any:
    """Return the content of a JSON file; raise ``DatasetError`` naming it."""
    try:
        return json.loads(read_file(file))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: not JSON ({error})") from error


def number(where: str, keys: Table, key: str, minimum: float = -math.inf) -> float:
    """Return a finite number of at least ``minimum``."""
    if key not in keys:
        raise DatasetError(f"{where}: key '{key}' is missing")
    value = keys[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DatasetError(f"{where}: key '{key}' is {shortened(value)}, not a number")
    if not math.isfinite(_float(value)):
        raise DatasetError(f"{where}: key '{key}' is {shortened(value)}, must be finite")
    if value < minimum:
        raise DatasetError(f"{where}: key '{key}' is {value}, must be at least {minimum:g}")
    return float(value)


def side_px(where: str, keys: Table, key: str) -> int:
    """Return a whole number of pixels."""
    value = number(where, keys, key)
    if value != int(value):
        raise DatasetError(f"{where}: key '{key}' is {value}, not a whole number of pixels")
    return int(value)


def text(where: str, keys: Table, key: str) -> str:
    """Return a string that is not empty and can be printed."""
    value = keys.get(key)
    if not isinstance(value, str) or not value:
        raise DatasetError(f"{where}: key '{key}' is missing or not a string")
    if not value.isprintable():
        raise DatasetError(f"{where}: key '{key}' is {shortened(value)}, which is not printable")
    return value


def matrix_rows(where: str, keys: Table, key: str, columns: int = 4) -> list[Sequence[float]]:
    """Return the rows of a matrix of 3 or 4 rows and ``columns`` finite numbers each."""
    matrix = keys.get(key)
    if not isinstance(matrix, list) or len(matrix) not in (3, columns):
        raise DatasetError(f"{where}: key '{key}' is missing or not {columns}x{columns}")
    if any(not isinstance(row, list) or len(row) != columns for row in matrix):
        raise DatasetError(f"{where}: key '{key}' is missing or not {columns}x{columns}")
    for i, row in enumerate(matrix):
        for j, value in enumerate(row):
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not is_number or not math.isfinite(_float(value)):
                raise DatasetError(
                    f"{where}: {key}[{i}][{j}] is {shortened(value)}, not a finite number"
                )
    return matrix


def pose_of_rows(where: str, key: str, rows: Sequence[Sequence[float]]) -> Pose:
    """Return the pose of a rigid 3x4 or 4x4 matrix."""
    try:
        return Pose.from_matrix(rows)
    except InvalidInput as error:
        raise DatasetError(f"{where}: {key}: {error}") from error


def pose_of_quaternion(where: str, translation: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """Return a pose from numbers as files print them: a norm within 1e-3 of 1 is normalised."""
    norm = math.hypot(*wxyz)
    if not abs(norm - 1.0) < FILE_NORM_TOLERANCE:
        raise DatasetError(f"{where}: quaternion {tuple(wxyz)} has norm {norm:.6g}, must be 1")
    x, y, z = translation
    w, i, j, k = (value / norm for value in wxyz)
    try:
        return Pose((x, y, z), (w, i, j, k))
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error


def finite_numbers(where: str, words: Sequence[str]) -> list[float]:
    """Return the numbers of a line's words."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{where}: {error}") from error
    for value in values:
        if not math.isfinite(value):
            raise DatasetError(f"{where}: {value} is not a finite number")
    return values


def text_lines(file: Path) -> list[str]:
    """Return a text file's lines; raise ``DatasetError`` for bytes that are no UTF-8."""
    try:
        return read_file(file).decode().splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: not a text file ({error.reason})") from error


def shortened(value: object) -> str:
    """Return a value as an error shows it: on one line, and not a page of digits."""
    try:
        shown = repr(value)
    except ValueError:
        return "a number of more digits than are printed"
    return shown if len(shown) <= MAX_SHOWN else shown[:MAX_SHOWN] + "..."


def _float(value: float) -> float:
    """A whole number beyond every float is infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


LENS_KEYS = {
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def lens_of(where: str, model: object, keys: Table) -> Lens | None:
    """Return the lens, ``None`` for a pinhole."""
    if not isinstance(model, str) or model not in LENS_KEYS:
        raise DatasetError(f"{where}: camera_model {model!r} is none of {', '.join(LENS_KEYS)}")
    given = {key: number(where, keys, key) for key in DISTORTION_KEYS if key in keys}
    known = LENS_KEYS[model]
    for key, value in given.items():
        if value != 0.0 and key not in known:
            raise DatasetError(
                f"{where}: lens distortion {key} = {value:g} does not belong to camera_model "
                f"{model}, which has {', '.join(known) or 'none'}"
            )
    return _lens(model, {key: given.get(key, 0.0) for key in known})


def _lens(model: str, coefficients: dict[str, float]) -> Lens | None:
    if model == "OPENCV_FISHEYE":
        return FisheyeLens(**coefficients)
    return BrownLens(**coefficients) if any(coefficients.values()) else None
