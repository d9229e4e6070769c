"""Read the parts that dataset files are made of: JSON, TOML, lines of numbers, poses and lenses.

``where`` is the file and the place in it; every error is a ``DatasetError`` that starts with it.
Tables are checked key by key by ``rfcore.tables``.

Lenses are named by a camera model and coefficients k1, k2, p1, ... Models are COLMAP's names, which
nerfstudio shares. Coefficients of zero are no lens, except of a fisheye, which is one even then. A
coefficient that the model does not have, and a model that is not known, are errors.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rfcore.camera import Pose
from rfcore.errors import DatasetError, InvalidData, InvalidInput
from rfcore.files import read_regular
from rfcore.geodesy import Anchor, anchor_of_values
from rfcore.lens import BrownLens, FisheyeLens, Lens
from rfcore.tables import Table

POSE_SHAPES = ((3, 4), (4, 4))
"""Rows and columns of a pose's matrix; what a fourth row holds is checked with the pose."""
FILE_NORM_TOLERANCE = 1e-3
"""Trajectories are printed with as few as four decimals."""


@contextmanager
def blamed_on(where: object) -> Iterator[None]:
    """Turn ``InvalidInput`` of the block into a ``DatasetError`` that begins with ``where``."""
    try:
        yield
    except InvalidInput as error:
        raise DatasetError(f"{where}: {error}") from error


MAX_TEXT_BYTES = 1 << 27
"""200,000 pictures at 600 bytes each; parsed, JSON takes some ten times its size."""

MAX_BINARY_BYTES = 1 << 32
"""COLMAP's tables of 10,000 pictures with all their points take a tenth."""


def read_file(file: Path, max_bytes: int = MAX_BINARY_BYTES) -> bytes:
    """Return a file's bytes; raise ``DatasetError`` naming it."""
    try:
        return read_regular(file, max_bytes)
    except InvalidData as error:
        raise DatasetError(f"{file}: {error}") from error
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read ({error.strerror})") from error


def load_json(file: Path) -> Any:
    """Return the content of a JSON file; raise ``DatasetError`` naming it."""
    try:
        return json.loads(read_file(file, MAX_TEXT_BYTES))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file}: not JSON ({error})") from error


def load_toml(file: Path) -> dict[str, Any]:
    """Return the content of a TOML file; raise ``DatasetError`` naming it."""
    try:
        return tomllib.loads(read_file(file, MAX_TEXT_BYTES).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DatasetError(f"{file}: not TOML ({error})") from error


def table_at(where: str, values: object) -> Table:
    """Return a table whose errors are ``DatasetError`` and begin with ``where``."""

    def fail(key: str, problem: str) -> DatasetError:
        return DatasetError(f"{where}: key '{key}' {problem}" if key else f"{where}: {problem}")

    return Table(values, fail)


def anchor_at(where: str, values: Mapping[str, Any] | None) -> Anchor | None:
    """Return the anchor that a table states (``rfcore.geodesy``), None where there is no table."""
    if values is None:
        return None
    with blamed_on(where):
        return anchor_of_values(values)


def pose_of_rows(where: str, key: str, rows: Sequence[Sequence[float]]) -> Pose:
    """Return the pose of a rigid 3x4 or 4x4 matrix."""
    with blamed_on(f"{where}: {key}"):
        return Pose.from_matrix(rows)


def pose_of_quaternion(where: str, translation: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """Return a pose from numbers as files print them: a norm within 1e-3 of 1 is normalised."""
    norm = math.hypot(*wxyz)
    if not abs(norm - 1.0) < FILE_NORM_TOLERANCE:
        raise DatasetError(f"{where}: quaternion {tuple(wxyz)} has norm {norm:.6g}, must be 1")
    x, y, z = translation
    w, i, j, k = (value / norm for value in wxyz)
    with blamed_on(where):
        return Pose((x, y, z), (w, i, j, k))


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


def filled_lines(file: Path) -> list[tuple[str, str]]:
    """Return the place and the text of every line that is not blank."""
    lines = enumerate(text_lines(file), start=1)
    return [(f"{file}: line {number}", line) for number, line in lines if line.strip()]


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
    given = {key: keys.number(key) for key in DISTORTION_KEYS if key in keys}
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
