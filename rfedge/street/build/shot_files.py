"""The files of one shot, and whether they are all there.

``SPLIT/images/N.png`` is written last, so that a picture means a finished shot. Depth is z in
millimetres, 16 bit, 0 where there is none or it is beyond 65.535 m. Classes are the numbers of
``rfedge.street.geometry.mesh.Label``. Points are what a LiDAR at the camera would hit, a thousand
of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.dataset.source import SourcePoints
from rfcore.dataset.write import write_points
from rfcore.errors import DatasetError
from rfcore.files import write_whole
from rfcore.image import Rgb, write_png
from rfedge.street.geometry.mesh import F32
from rfedge.street.shots import Shot, Split

__all__ = ["ShotFiles", "depth_mm", "read_depth_m"]

FARTHEST_MM = 65535
PLACES = ("images", "depth", "classes", "points")


@dataclass(frozen=True)
class ShotFiles:
    """Where a shot's files lie."""

    folder: Path
    split: Split
    name: str

    @staticmethod
    def of(folder: Path, shot: Shot) -> ShotFiles:
        """Return a shot's files in the dataset's folder."""
        return ShotFiles(folder, shot.split, shot.name)

    @property
    def picture(self) -> Path:
        """8-bit RGB."""
        return self._file("images", "png")

    @property
    def points(self) -> Path:
        """Surface points."""
        return self._file("points", "ply")

    @property
    def picture_name(self) -> str:
        """The picture's path in the dataset."""
        return f"{self.split}/images/{self.name}.png"

    @property
    def done(self) -> bool:
        """Whether the shot is finished."""
        return self.picture.is_file()

    def write(
        self, rgb: Rgb, depth_m: F32, labels: NDArray[np.uint8], points: SourcePoints
    ) -> None:
        """Write all files, each whole or not at all. Raises ``OSError``."""
        for place in PLACES:
            (self.folder / self.split / place).mkdir(parents=True, exist_ok=True)
        write_whole(self._file("depth", "png"), _png_bytes(depth_mm(depth_m)))
        write_whole(self._file("classes", "png"), _png_bytes(labels))
        write_points(self.points, points)
        write_png(self.picture, rgb)

    def _file(self, place: str, suffix: str) -> Path:
        return self.folder / self.split / place / f"{self.name}.{suffix}"


def depth_mm(depth_m: F32) -> NDArray[np.uint16]:
    """Return z in whole millimetres, 0 for what is farther than 65.535 m."""
    rounded = np.floor(depth_m.astype(np.float64) * 1000 + 0.5)
    return np.where(rounded <= FARTHEST_MM, rounded, 0).astype(np.uint16)


def read_depth_m(path: Path) -> F32:
    """Return z in metres float32 [H, W], infinite where the file has none.

    Raises ``DatasetError`` naming the file.
    """
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16 or stored.ndim != 2:
        raise DatasetError(f"{path}: no 16-bit picture of depths")
    return np.where(stored == 0, np.inf, stored / 1000).astype(np.float32)


def _png_bytes(values: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    _, encoded = cv2.imencode(".png", values)
    return encoded.tobytes()
