"""Convert a dataset of any format into pinhole pictures with a ``transforms.json``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple
from pathlib import Path

import numpy as np

from rfcore.camera import TileOrigin
from rfcore.dataset import Dataset, read_dataset
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput
from rfcore.files import whole_folder
from rfcore.image import write_png
from rfcore.views import PosedPicture

__all__ = ["convert_dataset", "global_points", "write_in_own_world"]


def convert_dataset(
    path: Path, out: Path, size_px: tuple[int, int] | None, chosen: slice = slice(None)
) -> str:
    """Write ``out`` and return one line about it.

    Pictures are undistorted and reduced once; poses and points keep the dataset's own world.
    Raises ``InvalidInput`` when ``out`` exists, ``DatasetError`` naming what is wrong in ``path``.
    """
    start, step = (1 if n is None else n for n in (chosen.start, chosen.step))
    if step < 1 or start < 0:
        raise InvalidInput("every", "must be at least 1, and the offset at least 0")
    dataset = read_dataset(path, distortion="undistort", size_px=size_px)
    pictures = dataset.pictures[chosen]
    if not pictures:
        raise InvalidInput("offset", f"leaves none of the {len(dataset.pictures)} pictures")
    with whole_folder(out) as folder:
        write_in_own_world(folder, dataset, enumerate(pictures), global_points(dataset))
    lens = f", {dataset.undistorted} of the dataset's undistorted" if dataset.undistorted else ""
    return f"{out}: {len(pictures)} pictures{lens}"


def write_in_own_world(
    folder: Path,
    dataset: Dataset,
    numbered: Iterable[tuple[int, PosedPicture]],
    points: SourcePoints | None,
) -> None:
    """Write pictures, points and anchor of a dataset in its own world, without a tile's origin.

    The pictures are named by their numbers.
    """
    (folder / "images").mkdir(parents=True)
    timed = any(picture.time_ns for picture in dataset.pictures)
    origin, anchor = dataset.tile_origin, dataset.anchor
    written = []
    for number, picture in numbered:
        name = f"images/{number:06d}.png"
        write_png(folder / name, picture.read())
        written.append(
            WrittenPicture(
                file_path=name,
                camera=SourceCamera(picture.camera.intrinsics),
                world_from_cam=origin.globalise(picture.camera.world_from_cam),
                time_ns=picture.time_ns if timed else None,
            )
        )
    if anchor is not None:
        anchor = anchor.relative_to(TileOrigin(-origin.east_m, -origin.north_m, -origin.up_m))
    write_transforms(folder, written, points, anchor)


def global_points(dataset: Dataset) -> SourcePoints | None:
    """Return the points in the dataset's own world."""
    if dataset.points is None:
        return None
    xyz_m = dataset.points.xyz_m + np.array(astuple(dataset.tile_origin))
    return SourcePoints(xyz_m, dataset.points.rgb)
