"""A hash grid as the content of an archive.

Arrays: ``table`` float16 [entries, 2], ``matrices`` float32 [weights], and of the occupancy's bits
the words that are not zero: ``occupancy_at`` uint32, ascending, and ``occupancy_words`` uint32.
The header's ``ngp`` holds the shape: cells of every level (no formula to round differently
somewhere), log2 of T, hidden width, the box and the steps along a ray.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.interface import NGP, Bounds, FieldMetadata
from rfcore.field.metadata import stored_metadata
from rfcore.ngp.parameters import NgpParameters
from rfcore.ngp.shape import HashGrid, Marching, NgpShape, Space

__all__ = ["as_stored", "bounds_of", "ngp_archive", "ngp_of_archive"]

ARRAYS = {"table", "matrices", "occupancy_at", "occupancy_words"}
FLOAT16_MAX = np.float32(np.finfo(np.float16).max)


def as_stored(numbers: NgpParameters) -> NgpParameters:
    """Return what reading an archive of ``numbers`` gives: the table rounded to float16.

    The file is half as long. Features are of the order of 0.1, so they move by at most 2**-14, and
    quality is measured on what was stored.
    """
    table = np.clip(numbers.table, -FLOAT16_MAX, FLOAT16_MAX).astype(np.float16)
    return NgpParameters(
        numbers.shape, table.astype(np.float32), numbers.matrices, numbers.occupancy
    )


def bounds_of(space: Space) -> Bounds:
    """Return the box of the space the field is made for."""
    sides = list(zip(space.centre_m, space.half_m, strict=True))
    low, high = ([c + sign * h for c, h in sides] for sign in (-1, 1))
    return Bounds((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def ngp_archive(numbers: NgpParameters, metadata: FieldMetadata) -> Archive:
    """Return the archive of ``numbers``, which ``as_stored`` has rounded."""
    used = np.flatnonzero(numbers.occupancy)
    arrays: dict[str, NDArray[Any]] = {
        "table": numbers.table.astype(np.float16),
        "matrices": numbers.matrices,
        "occupancy_at": used.astype(np.uint32),
        "occupancy_words": numbers.occupancy[used],
    }
    header = stored_metadata(metadata, bounds_of(numbers.shape.space))
    return Archive(NGP, {**header, "ngp": _stored_shape(numbers.shape)}, arrays)


def ngp_of_archive(archive: Archive) -> NgpParameters:
    """Return the numbers of an archive.

    Raises ``InvalidInput``, ``KeyError`` or ``TypeError`` if it does not hold a hash grid; the
    shape is checked before anything of its size is made.
    """
    if set(archive.arrays) != ARRAYS:
        raise InvalidInput("archive", f"arrays {', '.join(archive.arrays)} are not a hash grid")
    shape = _shape(archive.metadata["ngp"])
    table, matrices = archive.arrays["table"], archive.arrays["matrices"]
    if table.dtype != np.float16:
        raise InvalidInput("ngp.table", f"is {table.dtype}, not float16")
    occupancy = _occupancy(shape, archive.arrays["occupancy_at"], archive.arrays["occupancy_words"])
    return NgpParameters(shape, table.astype(np.float32), matrices, occupancy)


def _occupancy(shape: NgpShape, at: NDArray[Any], words: NDArray[Any]) -> NDArray[np.uint32]:
    if at.dtype != np.uint32 or words.dtype != np.uint32 or at.shape != words.shape or at.ndim != 1:
        raise InvalidInput("ngp.occupancy", f"{at.dtype} {at.shape}, {words.dtype} {words.shape}")
    total = shape.occupancy_words
    if len(at) > total or (len(at) and int(at[-1]) >= total):
        raise InvalidInput("ngp.occupancy", f"{len(at)} words do not fit the grid's {total}")
    if len(at) > 1 and not np.all(at[1:] > at[:-1]):
        raise InvalidInput("ngp.occupancy", "its words are not in ascending order")
    occupancy = np.zeros(total, np.uint32)
    occupancy[at] = words
    return occupancy


def _stored_shape(shape: NgpShape) -> dict[str, Any]:
    space, marching = shape.space, shape.marching
    return {
        "level_cells": [list(cells) for cells in shape.grid.level_cells],
        "log2_T": shape.grid.log2_T,
        "hidden": shape.hidden,
        "occupancy_cells": list(shape.occupancy_cells),
        "centre_m": list(space.centre_m),
        "half_m": list(space.half_m),
        "unbounded": space.unbounded,
        "near_m": marching.near_m,
        "growth": marching.growth,
        "steps": marching.steps,
    }


def _shape(stored: Mapping[str, Any]) -> NgpShape:
    if not isinstance(stored["unbounded"], bool):
        raise InvalidInput("ngp.unbounded", f"{stored['unbounded']!r} is neither true nor false")
    levels = tuple(_cells(cells) for cells in stored["level_cells"])
    return NgpShape(
        HashGrid(levels, _whole(stored["log2_T"])),
        Space(_metres(stored["centre_m"]), _metres(stored["half_m"]), stored["unbounded"]),
        Marching(float(stored["near_m"]), float(stored["growth"]), _whole(stored["steps"])),
        _whole(stored["hidden"]),
        _cells(stored["occupancy_cells"]),
    )


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise InvalidInput("ngp", f"{value!r} is not a whole number")
    return value


def _cells(values: Any) -> tuple[int, int, int]:
    x, y, z = (_whole(value) for value in values)
    return (x, y, z)


def _metres(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
