r"""Posed pictures from a COLMAP model and the folder ``images`` it was made from.

The model lies in ``sparse/N``, ``sparse`` or the folder itself, in text or binary form (binary is
preferred, as in COLMAP). Of several models the one with most pictures is read, which is said.
Pictures lie in ``images``, ``input`` or, as copies of another size, ``images_2``, ``images_4`` or
``images_8``; names may begin with that folder. They are in the order of their names. Poses are
cam_from_world with OpenCV camera axes, quaternions w, x, y, z; pixel centres are at +0.5 as here.
Both forms are described in COLMAP's documentation, "Output Format".

Binary, little-endian (``cameras.bin``, ``images.bin``, ``points3D.bin``)::

    cameras   uint64 n;  n times  uint32 id, int32 model, uint64 width, uint64 height, float64 ...
    images    uint64 n;  n times  uint32 id, float64 qw qx qy qz tx ty tz, uint32 camera, name\0,
                                  uint64 m, m times (float64 x, float64 y, uint64 point)
    points3D  uint64 n;  n times  uint64 id, float64 x y z, uint8 r g b, float64 error,
                                  uint64 m, m times (uint32 image, uint32 index)

Text (``cameras.txt``, ``images.txt``, ``points3D.txt``): lines that start with ``#`` are comments.
An image takes two lines; the second, its 2D points, may be empty and is skipped.
"""

from __future__ import annotations

import shlex
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.camera import Intrinsics, Pose
from rfcore.dataset.keys import (
    LENS_MODELS,
    blamed_on,
    finite_numbers,
    lens_model,
    lens_of,
    pose_of_quaternion,
    read_file,
    table_at,
    text_lines,
)
from rfcore.dataset.picture_file import posed_picture
from rfcore.dataset.picture_name import file_inside, find_picture
from rfcore.dataset.source import Source, SourceCamera, SourcePicture, SourcePoints
from rfcore.errors import DatasetError
from rfcore.lens import FisheyeLens
from rfcore.tables import shortened

MODEL_NAMES = {model.number: name for name, model in LENS_MODELS.items()}
MAX_NAME = 60
IMAGES, DISTORTED = "images", "distorted"
"""Folder of pictures, and that of INRIA's model of the pictures in ``input``, with their lens."""


@dataclass(frozen=True)
class ColmapImage:
    """One registered image; ``where`` is its place in the file."""

    where: str
    name: str
    camera_id: int
    cam_from_world: Pose


@dataclass(frozen=True)
class ColmapModel:
    """Cameras by id, images in the order of the file, points if there are any."""

    cameras: dict[int, SourceCamera]
    images: tuple[ColmapImage, ...]
    points: SourcePoints | None


def parameter_count(where: str, name: object) -> int:
    """Return how many parameters a camera model has; ``DatasetError`` for an unknown one."""
    model = lens_model(where, name)
    return model.focal_lengths + 2 + len(model.coefficients)


def camera_of(
    where: str, name: str, size_px: tuple[int, int], parameters: Sequence[float], remedy: str = ""
) -> SourceCamera:
    """Return a camera from its parameters, which are f or fx, fy, then cx, cy, then the lens.

    Raises ``DatasetError`` for a lens that is not read, which ends with ``remedy``.
    """
    needed = parameter_count(where, name)
    if len(parameters) != needed:
        raise DatasetError(f"{where}: {name} has {needed} parameters, not {len(parameters)}")
    model = LENS_MODELS[name]
    focal = model.focal_lengths
    values = dict(zip(model.coefficients, parameters[focal + 2 :], strict=True))
    lens = lens_of(where, name, table_at(where, values), remedy)
    fx_px, fy_px = parameters[0], parameters[focal - 1]
    cx_px, cy_px = parameters[focal : focal + 2]
    with blamed_on(where):
        return SourceCamera(Intrinsics(*size_px, fx_px, fy_px, cx_px, cy_px), lens)


def camera_parameters(camera: SourceCamera) -> tuple[str, list[float]]:
    """Return the name of a camera's model and its parameters; the inverse of ``camera_of``."""
    k, lens = camera.intrinsics, camera.lens
    if lens is None:
        name = "PINHOLE"
    elif isinstance(lens, FisheyeLens):
        name = "OPENCV_FISHEYE"
    else:
        beyond = any(getattr(lens, key, 0.0) for key in ("k3", "k4", "k5", "k6"))
        name = "FULL_OPENCV" if beyond else "OPENCV"
    coefficients = [float(getattr(lens, key, 0.0)) for key in LENS_MODELS[name].coefficients]
    return name, [k.fx_px, k.fy_px, k.cx_px, k.cy_px, *coefficients]


def image_of(where: str, name: str, camera_id: int, numbers: Sequence[float]) -> ColmapImage:
    """Return an image from qw, qx, qy, qz, tx, ty, tz."""
    if not name.isprintable() or not name:
        raise DatasetError(f"{where}: name {shortened(name)} is empty or not printable")
    where = f"{where} ({name[:MAX_NAME]})"
    pose = pose_of_quaternion(where, numbers[4:7], numbers[:4])
    return ColmapImage(where, name, camera_id, pose)


MAX_NAME_BYTES = 4096
POINT2D_BYTES = 24
TRACK_BYTES = 8


def read_binary_model(folder: Path, remedy: str = "") -> ColmapModel:
    """Read a binary model. Raises ``DatasetError`` naming the file and the place in it.

    An error about a lens ends with ``remedy``.
    """
    return ColmapModel(
        cameras=dict(_cameras(_Bytes(folder / "cameras.bin"), remedy)),
        images=tuple(_images(_Bytes(folder / "images.bin"))),
        points=_points(folder / "points3D.bin"),
    )


class _Bytes:
    """A file's bytes, taken from the front; running out of them is a ``DatasetError``."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._content = read_file(file)
        self._at = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the values of a struct layout."""
        start = self._at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._content, start)

    def skip(self, count: int) -> None:
        left = len(self._content) - self._at
        if count > left:
            raise DatasetError(f"{self.file}: byte {self._at}: {count} bytes needed, {left} left")
        self._at += count

    def take_name(self) -> str:
        end = self._content.find(b"\0", self._at, self._at + MAX_NAME_BYTES)
        if end < 0:
            raise DatasetError(f"{self.file}: byte {self._at}: a name has no end")
        name = self._content[self._at : end]
        self._at = end + 1
        try:
            return name.decode()
        except UnicodeDecodeError as error:
            raise DatasetError(f"{self.file}: name {name!r} is not UTF-8") from error


def _cameras(content: _Bytes, remedy: str) -> Iterator[tuple[int, SourceCamera]]:
    (count,) = content.take("<Q")
    for i in range(count):
        camera_id, model_id, width_px, height_px = content.take("<IiQQ")
        where = f"{content.file}: camera {i}"
        model = MODEL_NAMES.get(model_id, f"number {model_id}")
        parameters = content.take(f"<{parameter_count(where, model)}d")
        yield camera_id, camera_of(where, model, (width_px, height_px), parameters, remedy)


def _images(content: _Bytes) -> Iterator[ColmapImage]:
    (count,) = content.take("<Q")
    for i in range(count):
        _, *numbers, camera_id = content.take("<I7dI")
        name = content.take_name()
        (points,) = content.take("<Q")
        content.skip(points * POINT2D_BYTES)
        yield image_of(f"{content.file}: image {i}", name, camera_id, numbers)


def _points(file: Path) -> SourcePoints | None:
    if not file.is_file():
        return None
    content = _Bytes(file)
    (count,) = content.take("<Q")
    rows = [_point(content) for _ in range(count)]
    if not rows:
        return None
    xyz_m, rgb = np.array([row[:3] for row in rows]), np.array([row[3:] for row in rows], np.uint8)
    with blamed_on(file):
        return SourcePoints(xyz_m, rgb)


def _point(content: _Bytes) -> tuple[float, float, float, int, int, int]:
    _, x, y, z, red, green, blue, _, track = content.take("<Q3d3BdQ")
    content.skip(track * TRACK_BYTES)
    return (x, y, z, red, green, blue)


def read_text_model(folder: Path, remedy: str = "") -> ColmapModel:
    """Read a text model as ``read_binary_model`` does; errors name the file and the line."""
    return ColmapModel(
        cameras=dict(_cameras_of_text(folder / "cameras.txt", remedy)),
        images=tuple(_images_of_text(folder / "images.txt")),
        points=_points_of_text(folder / "points3D.txt"),
    )


def _rows(file: Path, at_least: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the words of every line that is not a comment."""
    for i, line in enumerate(text_lines(file), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield _checked(f"{file}: line {i}", words, at_least)


def _checked(where: str, words: list[str], at_least: int) -> tuple[str, list[str]]:
    if len(words) < at_least:
        raise DatasetError(f"{where}: has {len(words)} values, at least {at_least} are needed")
    return where, words


def _cameras_of_text(file: Path, remedy: str) -> Iterator[tuple[int, SourceCamera]]:
    for where, words in _rows(file, 4):
        size_px = (_whole(where, words[2]), _whole(where, words[3]))
        parameters = finite_numbers(where, words[4:])
        yield _whole(where, words[0]), camera_of(where, words[1], size_px, parameters, remedy)


def _images_of_text(file: Path) -> Iterator[ColmapImage]:
    lines = iter(enumerate(text_lines(file), start=1))
    for i, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where, words = _checked(f"{file}: line {i}", line.split(maxsplit=9), 10)
        numbers = finite_numbers(where, words[1:8])
        yield image_of(where, words[9].strip(), _whole(where, words[8]), numbers)
        next(lines, None)


def _points_of_text(file: Path) -> SourcePoints | None:
    if not file.is_file():
        return None
    rows = [finite_numbers(where, words[1:7]) for where, words in _rows(file, 8)]
    if not rows:
        return None
    table = np.array(rows)
    if (table[:, 3:] < 0).any() or (table[:, 3:] > 255).any():
        raise DatasetError(f"{file}: a point's colour is outside 0..255")
    return SourcePoints(np.ascontiguousarray(table[:, :3]), table[:, 3:].astype(np.uint8))


def _whole(where: str, word: str) -> int:
    if not word.isascii() or not word.isdigit():
        raise DatasetError(f"{where}: '{word}' is not a whole number")
    return int(word[:20])


def colmap_models(folder: Path) -> list[Path]:
    """Return where a dataset's models lie: in ``sparse/N``, the one with most pictures first; else
    in ``sparse`` or the folder itself."""
    numbered = [path for path in sorted((folder / "sparse").glob("*")) if images_file(path)]
    if numbered:
        return sorted(numbered, key=_image_count, reverse=True)
    return [path for path in (folder / "sparse", folder) if images_file(path)][:1]


def images_file(model_folder: Path) -> Path | None:
    """Return the file that lists a model's images, None without one."""
    files = (model_folder / name for name in ("images.bin", "images.txt"))
    return next((file for file in files if file.is_file()), None)


def _image_count(model_folder: Path) -> int:
    """Return how many images a model has, as its file begins; 0 where it is damaged."""
    file = images_file(model_folder)
    if file is None:
        return 0
    if file.suffix == ".bin":
        with file.open("rb") as start:
            return int.from_bytes(start.read(8), "little")
    lines = [line for line in text_lines(file) if not line.lstrip().startswith("#")]
    return sum(bool(line.strip()) for line in lines[::2])


def read_colmap_source(model_folder: Path, others: Sequence[Path] = ()) -> Source:
    """Read a model and find its pictures; say that ``others``, which there are, are not read.

    Raises ``DatasetError`` naming the file.
    """
    file = images_file(model_folder)
    folders = _images_folders(model_folder)
    read = read_text_model if file is not None and file.suffix == ".txt" else read_binary_model
    model = read(model_folder, _undistorter(model_folder, folders[0]))
    ordered = sorted(model.images, key=lambda image: image.name)
    images_folder, notes = _folder_of(ordered, folders), list[str]()
    if images_folder.name != IMAGES:
        notes.append(f"pictures are taken from {images_folder}")
    if others:
        left = ", ".join(f"{other} of {_image_count(other)}" for other in others)
        notes.append(f"{model_folder} is read, of {len(ordered)} pictures; not read: {left}")
    return Source(
        file=file or model_folder / "images.bin",
        pictures=tuple(_picture(model, images_folder, image) for image in ordered),
        points=model.points,
        notes=tuple(notes),
    )


def _undistorter(model_folder: Path, images_folder: Path) -> str:
    """Return the command that undistorts the pictures of a model into a dataset."""
    words = ["--image_path", images_folder, "--input_path", model_folder]
    command = " ".join(shlex.quote(str(word)) for word in words)
    return f"; undistort them: colmap image_undistorter {command} --output_path undistorted"


def _images_folders(model_folder: Path) -> list[Path]:
    """Return the folders that the pictures may be in, the likeliest first."""
    above = (model_folder, *model_folder.absolute().parents[:2])
    kinds = (IMAGES, "input", *(f"{IMAGES}_{scale}" for scale in (2, 4, 8)))
    named = [folder / kind for kind in kinds for folder in above]
    if above[-1].name == DISTORTED:
        named.insert(0, above[-1].parent / "input")
    there = [folder for folder in named if folder.is_dir()]
    if not there:
        raise DatasetError(
            f"{model_folder}: no folder '{IMAGES}' or 'input' beside the model or two levels above"
        )
    return [*there, *(folder.parent for folder in there)]


def _folder_of(images: Sequence[ColmapImage], folders: Sequence[Path]) -> Path:
    """Return the first folder that has the first picture; the likeliest if none has."""
    first = images[:1]
    found = (f for f in folders for one in first if file_inside(one.where, f, one.name))
    return next(found, folders[0])


def _picture(model: ColmapModel, folder: Path, image: ColmapImage) -> SourcePicture:
    camera = model.cameras.get(image.camera_id)
    if camera is None:
        raise DatasetError(f"{image.where}: camera {image.camera_id} is not in the model")
    path = find_picture(image.where, folder, image.name)
    world_from_cam = image.cam_from_world.inverse()
    return posed_picture(image.where, image.name, path, camera, world_from_cam)
