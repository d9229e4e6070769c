"""Coloured surface points from a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rfcore.camera import TileOrigin
from rfcore.errors import DatasetError, FieldFormatError, InvalidInput
from rfcore.field.ply_table import Table, read_vertices
from rfcore.views import PointCloud

__all__ = ["read_points"]


def read_points(path: Path, tile_origin: TileOrigin) -> PointCloud:
    """Read x, y, z in metres and red, green, blue 0..255 of every vertex.

    The origin is subtracted in float64. Raises ``DatasetError`` naming the file.
    """
    try:
        table = read_vertices(path, ("x", "y", "z", "red", "green", "blue"))
        return PointCloud(_tile_relative(table, tile_origin), _rgb(path, table))
    except (FieldFormatError, InvalidInput) as error:
        raise DatasetError(f"points of {path}: {error}") from error


def _tile_relative(
    table: Table, origin: TileOrigin
) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    xyz_m = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    xyz_m -= (origin.east_m, origin.north_m, origin.up_m)
    return xyz_m.astype(np.float32)


def _rgb(path: Path, table: Table) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    colours = [table[name] for name in ("red", "green", "blue")]
    if any(colour.dtype != np.uint8 for colour in colours):
        raise DatasetError(f"points of {path}: red, green, blue must be uchar, 0..255")
    return np.stack(colours, axis=1)
