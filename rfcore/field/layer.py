"""A colour layer: the colours of a splat field under another light, in a tenth of its bytes.

It is an archive of kind ``layer`` for one base field, whose id its header states. Because that id
is covered by the archive's digest, the SHA-256 of the layer identifies the field that base and
layer make together.

What is added to the constant colour of splat i, in Y, R - G and B - G::

    own_i * OWN_STEP + sum over voxel sizes of (a_v * OFFSET_STEP + b_v * SLOPE_STEP * (y_i - 0.4))

with v the voxel that its mean lies in, y_i its luma under the base's light. All of a, b and own are
whole numbers; higher bands of the colour are scaled by ``bands`` / 64. Only float64 elementwise
additions, multiplications and roundings, so that the same colours come out on every machine.

Voxels are those that hold a mean of the base, in ascending order of x, y, z, so that they need no
addresses. Streams that are all 0 are not stored. Shape, opacity and levels of detail are the
base's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.integers import Integers, decode_columns, encode_columns
from rfcore.field.interface import (
    LAYER,
    SPLATS,
    Bounds,
    FieldMetadata,
    base_of,
    stored_metadata,
)
from rfcore.field.splats import SplatField
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians

ENCODING = "voxels-1"
VOXELS_M = (0.25, 1.0, 4.0, 16.0)
"""Sides of the voxels, powers of two so that dividing by them is exact."""
OFFSET_STEP = np.array([2.0, 4.0, 4.0]) / 255
SLOPE_STEP = np.array([1.0, 2.0, 2.0]) / 32
OWN_STEP = np.array([8.0, 16.0, 16.0]) / 255
MIDDLE_LUMA = 0.4
MAX_BANDS = 64
MAX_NUMBER = 1 << 15

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class ColourLayer:
    """The whole numbers of a layer: ``voxels[l]`` int32 [V_l, 6] (offset, slope), ``own`` [N, 3].

    Raises ``InvalidInput`` for numbers of another shape or out of range.
    """

    voxels: tuple[Integers, ...]
    own: Integers
    bands: int = MAX_BANDS

    def __post_init__(self) -> None:
        if len(self.voxels) != len(VOXELS_M):
            raise InvalidInput("layer", f"{len(self.voxels)} sizes of voxels, not {len(VOXELS_M)}")
        if not 0 <= self.bands <= MAX_BANDS:
            raise InvalidInput("layer.bands", f"{self.bands} is outside 0..{MAX_BANDS}")
        for numbers, columns in (*((v, 6) for v in self.voxels), (self.own, 3)):
            if numbers.ndim != 2 or numbers.shape[1] != columns:
                raise InvalidInput("layer", f"{numbers.shape} is not [N, {columns}]")
            if numbers.size and int(np.abs(numbers).max()) > MAX_NUMBER:
                raise InvalidInput("layer", f"a number is beyond {MAX_NUMBER}")


def voxels_of(means: NDArray[np.float32], side_m: float) -> tuple[NDArray[np.intp], int]:
    """Return the voxel of each mean [N], counted in ascending order of x, y, z, and how many."""
    x, y, z = np.floor(means.astype(np.float64) / side_m).T
    order = np.lexsort((z, y, x))
    first = np.zeros(len(order), bool)
    for axis in (x, y, z):
        first[1:] |= np.diff(axis[order]) != 0
    voxel = np.empty(len(order), np.intp)
    voxel[order] = np.cumsum(first)
    return voxel, int(first.sum()) + bool(len(order))


def luma_of(gaussians: Gaussians) -> F64:
    """Return the luma [N] of each splat's constant colour, 0..1.5."""
    rgb = np.clip(0.5 + gaussians.sh[:, 0].astype(np.float64) * SH_DC, 0.0, 1.5)
    return np.asarray(0.2126 * rgb[:, 0] + 0.7152 * rgb[:, 1] + 0.0722 * rgb[:, 2])


def layered_colours(base: Gaussians, layer: ColourLayer) -> Gaussians:
    """Return ``base`` in the layer's light; raise ``InvalidInput`` for a layer of another base."""
    if len(layer.own) != len(base):
        raise InvalidInput("layer", f"is for {len(layer.own)} splats, the base has {len(base)}")
    slope_of = luma_of(base) - MIDDLE_LUMA
    added = layer.own * OWN_STEP
    for side_m, numbers in zip(VOXELS_M, layer.voxels, strict=True):
        voxel, count = voxels_of(base.means, side_m)
        if len(numbers) != count:
            raise InvalidInput("layer", f"has {len(numbers)} voxels of {side_m:g} m, not {count}")
        mine = numbers[voxel]
        added = added + mine[:, :3] * OFFSET_STEP
        added = added + (mine[:, 3:] * SLOPE_STEP) * slope_of[:, None]
    sh = base.sh.astype(np.float64)
    sh[:, 0] += rgb_of(added) / SH_DC
    sh[:, 1:] *= layer.bands / MAX_BANDS
    return replace(base, sh=np.ascontiguousarray(sh, np.float32))


def layer_archive(layer: ColourLayer, base: SplatField, metadata: FieldMetadata) -> Archive:
    """Return the archive of a layer on ``base``."""
    parts = {f"voxels_{number}": part for number, part in enumerate(layer.voxels)}
    parts["own"] = layer.own
    coded = {name: encode_columns(part) for name, part in parts.items() if part.any()}
    encoding = {
        "name": ENCODING,
        "bands": layer.bands,
        "counts": {name: len(part) for name, part in parts.items()},
        "streams": {name: header for name, (header, _) in coded.items()},
    }
    header = stored_metadata(metadata, Bounds.around(base.gaussians.means))
    arrays = {name: stream for name, (_, stream) in coded.items()}
    return Archive(LAYER, {**header, "base": base.field_id, "encoding": encoding}, arrays)


def layered_field(archive: Archive, base: SplatField, metadata: FieldMetadata) -> SplatField:
    """Return the field that ``archive``, a layer, makes of ``base``.

    Raises ``InvalidInput`` if it is for another base, ``KeyError`` or ``TypeError`` if it is no
    layer.
    """
    stated = base_of(archive)
    if stated != base.field_id:
        raise InvalidInput("layer.base", f"is for field {stated}, not {base.field_id}")
    if base.archive().kind != SPLATS:
        raise InvalidInput("layer.base", f"{base.field_id} is a layer itself; take its own base")
    if metadata.antialiased != base.metadata.antialiased:
        raise InvalidInput("layer.antialiased", "differs from the base's")
    layer = _layer_of(archive, len(base.gaussians))
    gaussians = layered_colours(base.gaussians, layer)
    return base.derived(gaussians, metadata, archive)


def _layer_of(archive: Archive, splats: int) -> ColourLayer:
    encoding: Mapping[str, Any] = archive.metadata["encoding"]
    if encoding["name"] != ENCODING:
        raise InvalidInput("encoding", f"{encoding['name']!r} is not '{ENCODING}'")
    bands = encoding["bands"]
    if type(bands) is not int:
        raise InvalidInput("encoding.bands", f"{bands!r} is not a whole number")
    names: Sequence[str] = [f"voxels_{number}" for number in range(len(VOXELS_M))]
    if set(archive.arrays) != set(encoding["streams"]) or set(archive.arrays) - {*names, "own"}:
        raise InvalidInput("encoding", f"arrays {', '.join(archive.arrays)} are not its streams")

    def numbers(name: str, columns: int) -> Integers:
        count = encoding["counts"][name]
        if type(count) is not int or not 0 <= count <= splats:
            raise InvalidInput(f"encoding.{name}", f"{count!r} is outside 0..{splats}")
        if name not in archive.arrays:
            return np.zeros((count, columns), np.int32)
        return decode_columns(encoding["streams"][name], archive.arrays[name], (count, columns))

    return ColourLayer(tuple(numbers(name, 6) for name in names), numbers("own", 3), bands)


def rgb_of(ycc: F64) -> F64:
    """Return [N, 3] red, green, blue of Y = (R + 2 G + B) / 4, R - G, B - G."""
    green = ycc[:, 0] - 0.25 * (ycc[:, 1] + ycc[:, 2])
    return np.stack([green + ycc[:, 1], green, green + ycc[:, 2]], axis=1)
