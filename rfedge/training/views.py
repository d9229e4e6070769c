"""Choose the pictures to train on, those to hold out, and the points to start from.

Points can come from depth maps: one file for each picture, with the picture's name and the suffix
``.npy`` (float32 [H, W], metres) or ``.png`` (16 bits, millimetres, as nerfstudio and Record3D
write them). 0 means unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isqrt
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from rfcore.dataset import Dataset, Distortion, read_dataset
from rfcore.dataset.assemble import localised
from rfcore.dataset.source import read_points
from rfcore.errors import DatasetError, InvalidInput
from rfcore.train.start import points_from_depth
from rfcore.views import PointCloud, PosedPicture
from rfedge.training import Train

POINTS = 300_000
"""Approximate number of points to make: twice what a run draws by default."""
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
        depth = np.load(path, allow_pickle=False) if path.suffix == ".npy" else _stored(path)
    except (FFmpegError, OSError, StopIteration, IndexError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable depth map ({error})") from error
    if depth.ndim != 2:
        raise DatasetError(f"{path}: not a readable depth map of one channel")
    if path.suffix == ".npy":
        return np.asarray(depth, np.float32)
    if depth.dtype != np.uint16:
        raise DatasetError(f"{path}: {depth.dtype} pixels, a depth map has 16 bits of millimetres")
    return np.asarray(depth / MILLIMETRES, np.float32)


def _stored(path: Path) -> NDArray[Any]:
    """Return the file's pixels: [H, W], or [H, W, C] for more than one channel."""
    with av.open(str(path)) as container:
        return next(container.decode(video=0)).to_ndarray()


def _map_of(picture: PosedPicture, folder: Path) -> Path | None:
    stem = Path(picture.name).stem
    candidates = (folder / f"{stem}{suffix}" for suffix in (".npy", ".png"))
    return next((path for path in candidates if path.is_file()), None)


def _points_of(picture: PosedPicture, path: Path, count: int) -> PointCloud:
    rgb, depth_m = picture.read(), read_depth_m(path)
    if depth_m.shape != rgb.shape[:2]:
        raise DatasetError(f"{path}: {depth_m.shape} pixels, the picture has {rgb.shape[:2]}")
    step_px = max(1, isqrt(depth_m.size // max(count, 1)))
    if (mask := picture.read_mask()) is not None:
        depth_m = np.where(mask, depth_m, np.float32(0))
    return points_from_depth(picture.camera, rgb, depth_m, step_px)


def read_views(job: Train) -> tuple[Dataset, Dataset | None]:
    """Return the pictures to train on and those to measure on, around the same origin."""
    if job.held_out is not None and job.holdout is not None:
        raise InvalidInput("holdout", "goes without --held-out: choose one of the two")
    if job.points is not None and job.depths is not None:
        raise InvalidInput("depths", "goes without --points: choose one of the two")
    if not 0 < job.views_percent <= 100:
        raise InvalidInput("views_percent", f"{job.views_percent} is outside 0..100")
    distortion = Distortion.UNDISTORT if job.undistort else Distortion.REFUSE
    dataset = read_dataset(job.dataset, distortion=distortion, size_px=job.size_px)
    held_out = None
    if job.held_out is not None:
        held_out = read_dataset(
            job.held_out,
            tile_origin=dataset.tile_origin,
            distortion=distortion,
            size_px=job.size_px,
        )
    elif job.holdout is not None:
        dataset, held_out = split_every(dataset, job.holdout)
    if job.points is not None:
        given = read_points(job.points)
        notes = (*dataset.notes, *([given.note] if given.note else []))
        points = localised(given, dataset.tile_origin)
        dataset = replace(dataset, points=points, notes=notes)
    dataset = replace(dataset, pictures=share_of_views(dataset.pictures, job.views_percent))
    if job.depths is not None:
        points = points_from_depth_maps(dataset.pictures, job.depths)
        dataset = replace(dataset, points=points)
    return dataset, held_out


def split_every(dataset: Dataset, every: int) -> tuple[Dataset, Dataset]:
    """Return the dataset without every ``every``-th picture (from the first on), and those.

    The convention of mip-NeRF 360 and of 3DGS (``llffhold``).
    """
    if not 2 <= every <= len(dataset.pictures):
        raise InvalidInput("holdout", f"{every} is outside 2..{len(dataset.pictures)}")
    kept = tuple(picture for i, picture in enumerate(dataset.pictures) if i % every)
    held_out = dataset.pictures[::every]
    return replace(dataset, pictures=kept), replace(dataset, pictures=held_out)


def share_of_views(pictures: Sequence[PosedPicture], percent: float) -> tuple[PosedPicture, ...]:
    """Return ``percent`` of the pictures, at least one, spread evenly over all of them."""
    count = max(1, round(len(pictures) * percent / 100))
    return tuple(pictures[i * len(pictures) // count] for i in range(count))
