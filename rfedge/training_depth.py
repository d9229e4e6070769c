"""Points to start from out of depth maps beside a dataset's pictures.

One file a picture, named as the picture with another suffix: ``.npy``, float32 [H, W] metres, or
``.png``, 16 bits, millimetres (nerfstudio's and Record3D's). 0 means unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isqrt
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.errors import DatasetError
from rfcore.train.start import points_from_depth
from rfcore.views import PointCloud, PosedPicture

__all__ = ["points_from_depth_maps", "read_depth_m"]

POINTS = 300_000
"""About as many are made, twice what a run draws by default."""
MILLIMETRES = 1000.0


def points_from_depth_maps(pictures: Sequence[PosedPicture], folder: Path) -> PointCloud:
    """Return points of all pictures that have a depth map in ``folder``.

    Raises ``DatasetError`` when none has, or when a map cannot be read or has another size.
    """
    maps = [(picture, _map_of(picture, folder)) for picture in pictures]
    found = [(picture, path) for picture, path in maps if path is not None]
    if not found:
        raise DatasetError(f"{folder}: holds no depth map (.npy or .png) named as a picture")
    clouds = [_points_of(picture, path, POINTS // len(found)) for picture, path in found]
    return PointCloud(
        np.concatenate([cloud.xyz_m for cloud in clouds]),
        np.concatenate([cloud.rgb for cloud in clouds]),
    )


def read_depth_m(path: Path) -> NDArray[np.float32]:
    """Read a depth map in metres; raise ``DatasetError`` naming the file."""
    try:
        if path.suffix == ".npy":
            depth = np.load(path, allow_pickle=False)
        else:
            depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable depth map ({error})") from error
    if depth is None or depth.ndim != 2:
        raise DatasetError(f"{path}: not a readable depth map of one channel")
    if path.suffix == ".npy":
        return np.asarray(depth, np.float32)
    if depth.dtype != np.uint16:
        raise DatasetError(f"{path}: {depth.dtype} pixels, a depth map has 16 bits of millimetres")
    return np.asarray(depth / MILLIMETRES, np.float32)


def _map_of(picture: PosedPicture, folder: Path) -> Path | None:
    stem = Path(picture.name).stem
    candidates = (folder / f"{stem}{suffix}" for suffix in (".npy", ".png"))
    return next((path for path in candidates if path.is_file()), None)


def _points_of(picture: PosedPicture, path: Path, count: int) -> PointCloud:
    rgb, depth_m = picture.read(), read_depth_m(path)
    if depth_m.shape != rgb.shape[:2]:
        raise DatasetError(f"{path}: {depth_m.shape} pixels, the picture has {rgb.shape[:2]}")
    step_px = max(1, isqrt(depth_m.size // max(count, 1)))
    return points_from_depth(picture.camera, rgb, depth_m, step_px)
