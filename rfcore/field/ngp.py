"""A radiance field made of a multiresolution hash grid (Mueller et al. 2022).

``Quality.samples_per_ray`` trades accuracy for time: ``None`` takes every occupied step along a
ray, a number n merges neighbouring steps where a ray has more than n
(``rfcore.ngp.reference.render_rays``).

Arrays of its archive: ``table`` float16 [entries, 2], ``matrices`` float32 [weights], and of the
occupancy's bits the words that are not zero: ``occupancy_at`` uint32, ascending, and
``occupancy_words`` uint32. The header's ``ngp`` holds the shape: cells of every level (no formula
to round differently somewhere), log2 of T, hidden width, the box and the steps along a ray.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from copy import copy
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive, check_array_bytes, encode_archive
from rfcore.field.interface import NGP, Bounds, FieldMetadata, stored_metadata
from rfcore.field.quality import FULL, Quality, colour_at_scale, view_at_scale
from rfcore.files import DECODED_BYTES
from rfcore.native.backend import check_backend
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import HashGrid, Marching, NgpParameters, NgpShape, Space
from rfcore.views import View

ARRAYS = {"table", "matrices", "occupancy_at", "occupancy_words"}
FLOAT16_MAX = np.float32(np.finfo(np.float16).max)


def as_stored(numbers: NgpParameters) -> NgpParameters:
    """Return what reading an archive of ``numbers`` gives: the table rounded to float16.

    That halves the file. Features are of the order of 0.1, so they change by at most 2**-14, and
    quality is measured on the stored field.
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


def ngp_of_archive(archive: Archive, max_bytes: int = DECODED_BYTES) -> NgpParameters:
    """Return the numbers of an archive, which take ``max_bytes`` of memory at most.

    Raises ``InvalidInput``, ``KeyError`` or ``TypeError`` if it does not hold a hash grid; the
    shape is checked before anything of its size is made.
    """
    if set(archive.arrays) != ARRAYS:
        raise InvalidInput("archive", f"arrays {', '.join(archive.arrays)} are not a hash grid")
    shape = _shape(archive.metadata["ngp"])
    table, matrices = archive.arrays["table"], archive.arrays["matrices"]
    if table.dtype != np.float16:
        raise InvalidInput("ngp.table", f"is {table.dtype}, not float16")
    taken_bytes = 4 * (table.size + matrices.size + shape.occupancy_words)
    check_array_bytes(archive, taken_bytes, max_bytes)
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


class NgpField:
    """A hash grid with metadata, ready to render.

    The table is rounded to the float16 its file holds. ``threads`` and ``isa`` choose how it
    renders, never what: every choice gives the same bytes. Raises ``BackendUnavailable`` if this
    machine lacks ``isa``. Safe to share between threads.
    """

    def __init__(
        self,
        numbers: NgpParameters,
        metadata: FieldMetadata | None = None,
        *,
        threads: int = 1,
        isa: str | None = None,
    ) -> None:
        self.numbers = as_stored(numbers)
        self.metadata = metadata if metadata is not None else FieldMetadata(kind=NGP)
        if self.metadata.kind != NGP:
            raise InvalidInput("field.kind", f"'{self.metadata.kind}' is not '{NGP}'")
        self.isa = check_backend(threads, isa)
        self._threads = threads
        self._lock = Lock()
        self._renderer: NgpRenderer | None = None

    @cached_property
    def field_id(self) -> str:
        """SHA-256 of the field's archive, in hex."""
        return hashlib.sha256(encode_archive(self.archive())).hexdigest()

    @cached_property
    def bounds(self) -> Bounds:
        """The box the field was made for."""
        return bounds_of(self.numbers.shape.space)

    @property
    def primitives(self) -> int:
        """The number of trained numbers."""
        return self.numbers.table.size + self.numbers.matrices.size

    @property
    def most_detail(self) -> float:
        """Always 1: a hash grid is drawn whole."""
        return 1.0

    def archive(self) -> Archive:
        """Return the content of the field's file."""
        return ngp_archive(self.numbers, self.metadata)

    def with_threads(self, threads: int) -> NgpField:
        """Return the same field with a renderer of its own and so many threads."""
        own = copy(self)
        own.isa, own._threads = check_backend(threads, self.isa), threads
        own._renderer, own._lock = None, Lock()
        return own

    def prepare(self, quality: Quality = FULL) -> None:  # noqa: ARG002 - one renderer for all
        """Make the renderer; without this the first picture makes it."""
        self.renderer()

    def renderer(self) -> NgpRenderer:
        """Return the renderer, made when it is first needed and kept."""
        with self._lock:
            if self._renderer is None:
                self._renderer = NgpRenderer(self.numbers, threads=self._threads, isa=self.isa)
            return self._renderer

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Render colour, depth and opacity as ``camera`` sees them."""
        return view_at_scale(self._view, camera, quality)

    def _view(self, camera: Camera, quality: Quality) -> View:
        return self.renderer().render(camera, quality.samples_per_ray)

    def render_colour(self, camera: Camera, quality: Quality = FULL) -> NDArray[np.float32]:
        """Render only colour, float32 [H, W, 3]: the same bytes as ``render``, faster."""
        return colour_at_scale(self._colour, camera, quality)

    def _colour(self, camera: Camera, quality: Quality) -> NDArray[np.float32]:
        return self.renderer().render_colour(camera, quality.samples_per_ray)
