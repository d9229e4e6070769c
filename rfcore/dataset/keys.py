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
from dataclasses import dataclass
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
        return tomllib.loads(read_file(file, MAX_TEXT_BYTES).decode("utf-8-sig"))
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
        return read_file(file).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: not a text file ({error.reason})") from error


def filled_lines(file: Path) -> list[tuple[str, str]]:
    """Return the place and the text of every line that is not blank."""
    lines = enumerate(text_lines(file), start=1)
    return [(f"{file}: line {number}", line) for number, line in lines if line.strip()]


@dataclass(frozen=True)
class LensModel:
    """A camera model as COLMAP numbers it, and its coefficients in COLMAP's order.

    ``focal_lengths`` is 1 for fx = fy. ``read`` are the coefficients that a lens here has, those
    which files that name coefficients may add included; any other must be zero.
    """

    number: int
    focal_lengths: int
    coefficients: tuple[str, ...]
    read: tuple[str, ...]
    fisheye: bool = False

    @property
    def is_read(self) -> bool:
        """Whether every camera of this model is read, whatever its coefficients."""
        return set(self.coefficients) <= set(self.read) and self.focal_lengths > 0


BROWN, KANNALA = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
RATIONAL = (*BROWN, "k4", "k5", "k6")
THIN_PRISM = ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")
RAD_TAN = (*(f"k{i}" for i in range(6)), "p0", "p1", *(f"s{i}" for i in range(4)))
LENS_MODELS = {
    "PINHOLE": LensModel(1, 2, (), ()),
    "SIMPLE_PINHOLE": LensModel(0, 1, (), ()),
    "SIMPLE_RADIAL": LensModel(2, 1, ("k1",), ("k1",)),
    "RADIAL": LensModel(3, 1, ("k1", "k2"), ("k1", "k2")),
    "OPENCV": LensModel(4, 2, BROWN[:4], BROWN),
    "OPENCV_FISHEYE": LensModel(5, 2, KANNALA, KANNALA, fisheye=True),
    "FULL_OPENCV": LensModel(6, 2, RATIONAL, RATIONAL),
    "FOV": LensModel(7, 2, ("omega",), ()),
    "SIMPLE_RADIAL_FISHEYE": LensModel(8, 1, ("k1",), ("k1",), fisheye=True),
    "RADIAL_FISHEYE": LensModel(9, 1, ("k1", "k2"), ("k1", "k2"), fisheye=True),
    "THIN_PRISM_FISHEYE": LensModel(10, 2, THIN_PRISM, KANNALA, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": LensModel(11, 2, RAD_TAN, (), fisheye=True),
    "SIMPLE_DIVISION": LensModel(12, 1, ("k",), ()),
    "DIVISION": LensModel(13, 2, ("k",), ()),
    "SIMPLE_FISHEYE": LensModel(14, 1, (), (), fisheye=True),
    "FISHEYE": LensModel(15, 2, (), (), fisheye=True),
    "EUCM": LensModel(16, 2, ("alpha", "beta"), ()),
    "EQUIRECTANGULAR": LensModel(17, 0, (), ()),
}
"""Camera models of COLMAP 4.2, by the names that nerfstudio shares."""
READ_MODELS = ", ".join(name for name, model in LENS_MODELS.items() if model.is_read)
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def lens_model(where: str, name: object) -> LensModel:
    """Return a camera model by its name; ``DatasetError`` for one that is not known."""
    if not isinstance(name, str) or name not in LENS_MODELS:
        raise DatasetError(f"{where}: camera model {name} is none of {READ_MODELS}")
    return LENS_MODELS[name]


def lens_of(where: str, name: object, keys: Table, remedy: str = "") -> Lens | None:
    """Return the lens, ``None`` for a pinhole.

    Raises ``DatasetError`` for one that no lens here is, which ends with ``remedy``.
    """
    model = lens_model(where, name)
    given = {
        key: keys.number(key) for key in (*DISTORTION_KEYS, *model.coefficients) if key in keys
    }
    unread = [
        f"{key} = {value:g}" for key, value in given.items() if value and key not in model.read
    ]
    if unread or not model.focal_lengths:
        raise DatasetError(
            f"{where}: lens distortion {', '.join(unread) or 'of a sphere'} of camera_model {name} "
            f"is not read, only {', '.join(model.read) or 'none'}{remedy}"
        )
    coefficients = {key: given.get(key, 0.0) for key in model.read}
    if model.fisheye:
        return FisheyeLens(**coefficients)
    return BrownLens(**coefficients) if any(coefficients.values()) else None
