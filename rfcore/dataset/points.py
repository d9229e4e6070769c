"""Coloured surface points from a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.dataset.source import SourcePoints
from rfcore.errors import DatasetError, FieldFormatError, InvalidInput
from rfcore.field.ply_table import Table, read_vertices

__all__ = ["read_points"]


def read_points(path: Path) -> SourcePoints:
    """Read x, y, z in metres and red, green, blue 0..255 of every vertex.

    Raises ``DatasetError`` naming the file.
    """
    try:
        table = read_vertices(path, ("x", "y", "z", "red", "green", "blue"))
        xyz_m = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        return SourcePoints(xyz_m, _rgb(path, table))
    except (FieldFormatError, InvalidInput) as error:
        raise DatasetError(f"points of {path}: {error}") from error


def _rgb(path: Path, table: Table) -> NDArray[np.uint8]:
    colours = [table[name] for name in ("red", "green", "blue")]
    if any(colour.dtype != np.uint8 for colour in colours):
        raise DatasetError(f"points of {path}: red, green, blue must be uchar, 0..255")
    return np.stack(colours, axis=1)
