"""COLMAP's binary model: ``cameras.bin``, ``images.bin``, ``points3D.bin``, little-endian.

::

    cameras   uint64 n;  n times  uint32 id, int32 model, uint64 width, uint64 height, float64 ...
    images    uint64 n;  n times  uint32 id, float64 qw qx qy qz tx ty tz, uint32 camera, name\\0,
                                  uint64 m, m times (float64 x, float64 y, uint64 point)
    points3D  uint64 n;  n times  uint64 id, float64 x y z, uint8 r g b, float64 error,
                                  uint64 m, m times (uint32 image, uint32 index)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rfcore.dataset.colmap_model import (
    MODEL_IDS,
    ColmapImage,
    ColmapModel,
    camera_of,
    image_of,
    parameter_count,
)
from rfcore.dataset.keys import read_file
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.errors import DatasetError, InvalidInput

__all__ = ["read_binary_model"]

MAX_NAME_BYTES = 4096
POINT2D_BYTES = 24
TRACK_BYTES = 8


def read_binary_model(folder: Path) -> ColmapModel:
    """Read a binary model. Raises ``DatasetError`` naming the file and the place in it."""
    return ColmapModel(
        cameras=dict(_cameras(_Bytes(folder / "cameras.bin"))),
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


def _cameras(content: _Bytes) -> Iterator[tuple[int, SourceCamera]]:
    (count,) = content.take("<Q")
    for i in range(count):
        camera_id, model_id, width_px, height_px = content.take("<IiQQ")
        where = f"{content.file}: camera {i}"
        model = MODEL_IDS.get(model_id, f"number {model_id}")
        parameters = content.take(f"<{parameter_count(where, model)}d")
        yield camera_id, camera_of(where, model, (width_px, height_px), parameters)


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
    try:
        return SourcePoints(xyz_m, rgb)
    except InvalidInput as error:
        raise DatasetError(f"{file}: {error}") from error


def _point(content: _Bytes) -> tuple[float, float, float, int, int, int]:
    _, x, y, z, red, green, blue, _, track = content.take("<Q3d3BdQ")
    content.skip(track * TRACK_BYTES)
    return (x, y, z, red, green, blue)
