"""Convert a dataset of any format into pinhole pictures with a ``transforms.json``."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np

from rfcore.camera import TileOrigin
from rfcore.dataset import Dataset, read_dataset
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import InvalidInput
from rfcore.files import whole_folder
from rfcore.geodesy import Anchor
from rfcore.image import write_png

__all__ = ["convert_dataset", "global_anchor"]


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
    timed = any(picture.time_ns for picture in dataset.pictures)
    written = []
    with whole_folder(out) as folder:
        (folder / "images").mkdir()
        for i, picture in enumerate(pictures):
            name = f"images/{i:06d}.png"
            write_png(folder / name, picture.read())
            written.append(
                WrittenPicture(
                    file_path=name,
                    camera=SourceCamera(picture.camera.intrinsics),
                    world_from_cam=dataset.tile_origin.globalise(picture.camera.world_from_cam),
                    time_ns=picture.time_ns if timed else None,
                )
            )
        write_transforms(folder, written, _global_points(dataset), global_anchor(dataset))
    lens = f", {dataset.undistorted} of the dataset's undistorted" if dataset.undistorted else ""
    return f"{out}: {len(written)} pictures{lens}"


def global_anchor(dataset: Dataset) -> Anchor | None:
    """Return the anchor of the dataset's own world, where it states one."""
    if dataset.anchor is None:
        return None
    east_m, north_m, up_m = astuple(dataset.tile_origin)
    return dataset.anchor.relative_to(TileOrigin(-east_m, -north_m, -up_m))


def _global_points(dataset: Dataset) -> SourcePoints | None:
    if dataset.points is None:
        return None
    xyz_m = dataset.points.xyz_m + np.array(astuple(dataset.tile_origin))
    return SourcePoints(xyz_m, dataset.points.rgb)
