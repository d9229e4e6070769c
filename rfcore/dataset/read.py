"""A dataset of any format, recognised by the files that are there."""

from __future__ import annotations

from pathlib import Path

from rfcore.camera import TileOrigin
from rfcore.dataset.assemble import Dataset, Distortion, ReadOptions, assemble
from rfcore.dataset.source import Source
from rfcore.dataset.transforms import read_transforms_source, transforms_file
from rfcore.errors import DatasetError

__all__ = ["read_dataset", "read_source", "read_transforms"]


def read_dataset(
    path: Path,
    *,
    tile_origin: TileOrigin | None = None,
    distortion: Distortion | str = Distortion.REFUSE,
    size_px: tuple[int, int] | None = None,
) -> Dataset:
    """Read a dataset's folder, or the file that describes it; pixels are read on demand.

    Options as ``ReadOptions`` says. Raises ``DatasetError`` naming the file and the key at fault.
    """
    options = ReadOptions(tile_origin, Distortion(distortion), size_px)
    return assemble(read_source(path), options)


def read_source(path: Path) -> Source:
    """Read what is there, with its lenses and its own world."""
    if not path.is_dir():
        return read_transforms_source(path)
    file = transforms_file(path)
    if file is None:
        raise DatasetError(f"{path}: no dataset is recognised there (no transforms.json)")
    return read_transforms_source(file)


def read_transforms(path: Path, tile_origin: TileOrigin | None = None) -> Dataset:
    """Read a dataset whose pictures have no lens distortion."""
    return read_dataset(path, tile_origin=tile_origin)
