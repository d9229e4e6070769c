"""A delta: another version of a splat field, stored as the differences of all its parameters.

It is an archive of kind ``delta`` for one compressed base field, whose id its header states.
Because that id is covered by the archive's digest, the SHA-256 of the delta identifies the field
that base and delta make together, as with a colour layer (``rfcore.field.layer``).

The version has the base's splats in the base's order, and perhaps more after them. The header has
an ``encoding``, {"name": "delta-1", "count", "streams"}, with ``count`` splats in all; each array
is one stream of ``rfcore.field.integers``. First come the numbers of ``rfcore.field.splat_grid``
minus the base's, with ``means`` in the steps of the base's blocks; then the numbers of the added
splats, ``added.means`` and so on; then for each level of detail of the version, ``detail_50``, its
scales and opacities minus the full level's, minus the base's difference. Streams of zeros are left
out. Quantiser steps are the base's; decoding does not round.

A field of 7.7 MB fine-tuned to 24 frames takes 1.08 MB.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.field.archive import Archive
from rfcore.field.integers import LIMIT, Integers, decode_columns, encode_columns
from rfcore.field.interface import DELTA, SPLATS, Bounds, FieldMetadata, base_of, stored_metadata
from rfcore.field.quality import DETAILS, kept_of, splats_in
from rfcore.field.splat_archive import (
    GridSplats,
    check_decoded_size,
    grid_splats,
    level_name,
    stream_shapes,
)
from rfcore.field.splat_grid import (
    SplatNumbers,
    Steps,
    gaussians_of,
    level_numbers_of,
    level_of,
    means_of_steps,
    means_steps,
    numbers_of,
    rotations_like,
)
from rfcore.field.splats import SplatField
from rfcore.files import DECODED_BYTES
from rfcore.raster.gaussians import MAX_GAUSSIANS, Gaussians, joined

ENCODING = "delta-1"
ADDED = "added."
ADDED_MEANS = f"{ADDED}means"
"""Never left out: its bytes bound how many splats may be claimed."""
SMALLEST_BAND = 2
"""Steps by which a number of the higher bands of colours must differ to be stored."""
OF_BASE = tuple(f.name for f in fields(SplatNumbers) if f.name != "blocks")
"""Streams that hold differences to the base; blocks are the base's own."""


def delta_of(base: SplatField, version: SplatField) -> SplatField:
    """Return ``version`` as the nearest field that a delta on ``base`` can make.

    Raises ``InvalidInput`` if ``base`` is not compressed, or ``version`` has fewer splats or values
    that the base's grid cannot hold.
    """
    grid = _grid_of(base)
    archive = _archive(base.field_id, grid, version)
    return _field(archive, base, grid, version.metadata, DECODED_BYTES)


def _archive(base_id: str, grid: GridSplats, version: SplatField) -> Archive:
    gaussians, n = version.gaussians, len(grid.numbers.means)
    if len(gaussians) < n:
        raise InvalidInput("delta", f"{len(gaussians)} splats are fewer than the base's {n}")
    if gaussians.sh_degree != grid.sh_degree:
        raise InvalidInput("delta", f"SH degree {gaussians.sh_degree} is not the base's")
    numbers = _numbers_on(grid, splats_in(gaussians, slice(0, n)))
    parts: dict[str, Integers] = {
        name: getattr(numbers, name) - getattr(grid.numbers, name) for name in OF_BASE
    }
    parts["sh"] = _without_small_bands(parts["sh"])
    numbers = _with_differences(grid.numbers, parts)
    added = numbers_of(splats_in(gaussians, slice(n, None)), grid.steps)
    parts |= {f"{ADDED}{f.name}": getattr(added, f.name) for f in fields(SplatNumbers)}
    whole = _joined(numbers, added)
    for detail, level in version.levels.items():
        own = level_numbers_of(level, whole, grid.steps)
        parts[level_name(detail)] = own - _expected_level(grid, detail, len(own))
    coded = {
        name: encode_columns(part)
        for name, part in parts.items()
        if part.any() or (name == ADDED_MEANS and part.size)
    }
    encoding = {
        "name": ENCODING,
        "count": len(gaussians),
        "levels": sorted(version.levels),
        "streams": {name: header for name, (header, _) in coded.items()},
    }
    made = _gaussians(grid, numbers, added)
    header = stored_metadata(version.metadata, Bounds.around(made.means))
    arrays = {name: stream for name, (_, stream) in coded.items()}
    return Archive(DELTA, {**header, "base": base_id, "encoding": encoding}, arrays)


def delta_field(
    archive: Archive, base: SplatField, metadata: FieldMetadata, max_bytes: int = DECODED_BYTES
) -> SplatField:
    """Return the field made of ``base`` and the delta ``archive``.

    Raises ``InvalidInput`` if it is for another base or takes more than ``max_bytes``, ``KeyError``
    or ``TypeError`` if it is no delta.
    """
    stated = base_of(archive)
    if stated != base.field_id:
        raise InvalidInput("delta.base", f"is for field {stated}, not {base.field_id}")
    return _field(archive, base, _grid_of(base), metadata, max_bytes)


def _field(
    archive: Archive, base: SplatField, grid: GridSplats, metadata: FieldMetadata, max_bytes: int
) -> SplatField:
    """Return the field made of ``archive`` and ``base``, whose numbers are ``grid``."""
    if metadata.antialiased != base.metadata.antialiased:
        raise InvalidInput("delta.antialiased", "differs from the base's")
    stored = _Stored.of(archive, grid, max_bytes)
    numbers = _with_differences(grid.numbers, {name: stored.part(name) for name in OF_BASE})
    added = SplatNumbers(**{f.name: stored.part(f"{ADDED}{f.name}") for f in fields(SplatNumbers)})
    whole = _joined(numbers, added)
    levels = {}
    for detail in stored.levels:
        own = stored.part(level_name(detail))
        own = own + _expected_level(grid, detail, len(own))
        levels[detail] = level_of(own, whole, grid.steps)
    return base.derived(_gaussians(grid, numbers, added), metadata, archive, levels)


@dataclass(frozen=True)
class _Stored:
    """The streams of a delta, checked against what its header and its base say."""

    archive: Archive
    streams: Mapping[str, Any]
    shapes: Mapping[str, tuple[int, int]]
    levels: tuple[float, ...]

    @classmethod
    def of(cls, archive: Archive, grid: GridSplats, max_bytes: int) -> _Stored:
        """Check the header, and every size before it is allocated; raises as ``delta_field``."""
        encoding = archive.metadata["encoding"]
        if encoding["name"] != ENCODING:
            raise InvalidInput("encoding", f"{encoding['name']!r} is not '{ENCODING}'")
        count, n = encoding["count"], len(grid.numbers.means)
        if type(count) is not int or not n <= count <= MAX_GAUSSIANS:
            raise InvalidInput(
                "encoding.count", f"{count!r} is not a whole number {n}..{MAX_GAUSSIANS}"
            )
        check_decoded_size(count, grid.sh_degree, max_bytes)
        levels = tuple(encoding["levels"])
        if not set(levels) <= set(DETAILS[1:]):
            raise InvalidInput("encoding.levels", f"{levels} are not of {DETAILS[1:]}")
        of_base = stream_shapes(n, grid.sh_degree)
        shapes = {name: of_base[name] for name in OF_BASE}
        added = stream_shapes(count - n, grid.sh_degree)
        shapes |= {f"{ADDED}{name}": shape for name, shape in added.items()}
        shapes |= {level_name(detail): (kept_of(count, detail), 4) for detail in levels}
        streams = encoding["streams"]
        if set(archive.arrays) != set(streams) or set(streams) - set(shapes):
            raise InvalidInput(
                "encoding", f"arrays {', '.join(archive.arrays)} are not its streams"
            )
        if count > n and ADDED_MEANS not in streams:
            raise InvalidInput("encoding.streams", f"lack {ADDED_MEANS} of {count - n} splats")
        return cls(archive, streams, shapes, levels)

    def part(self, name: str) -> Integers:
        """Return the numbers of a stream; zeros if it was left out."""
        shape = self.shapes[name]
        if name not in self.archive.arrays:
            return np.zeros(shape, np.int32)
        return decode_columns(self.streams[name], self.archive.arrays[name], shape)


def check_base(base: SplatField) -> None:
    """Raise ``InvalidInput`` unless a delta can be of ``base``: a compressed field of its own."""
    archive = base.archive()
    if archive.kind != SPLATS or "encoding" not in archive.metadata:
        raise InvalidInput(
            "delta.base",
            f"{base.field_id} is not a compressed field of splats; learn another field (--as all)",
        )


def _grid_of(base: SplatField) -> GridSplats:
    check_base(base)
    return grid_splats(base.archive())


def _numbers_on(grid: GridSplats, gaussians: Gaussians) -> SplatNumbers:
    """Return the nearest numbers, with means and rotations in the form of the base's."""
    own = numbers_of(gaussians, grid.steps)
    steps = means_steps(gaussians.means, grid.exponents)
    if steps.size and np.abs(steps).max() >= LIMIT:
        raise InvalidInput("delta.means", "a splat went further than the base's grid reaches")
    return replace(
        own,
        blocks=grid.numbers.blocks,
        means=steps.astype(np.int32),
        rotations=rotations_like(gaussians.quaternions, grid.numbers.rotations),
    )


def _with_differences(base: SplatNumbers, parts: Mapping[str, Integers]) -> SplatNumbers:
    changed = {name: getattr(base, name) + parts[name] for name in OF_BASE}
    return SplatNumbers(blocks=base.blocks, **changed)


def _without_small_bands(sh: Integers) -> Integers:
    """Return differences [N, 3 K] of colours without the small ones of higher bands."""
    bands = sh.reshape(len(sh), 3, sh.shape[1] // 3).copy()
    higher = bands[:, :, 1:]
    higher[np.abs(higher) < SMALLEST_BAND] = 0
    return np.asarray(bands.reshape(sh.shape))


def _joined(numbers: SplatNumbers, added: SplatNumbers) -> SplatNumbers:
    """Return the numbers that levels of detail are relative to; blocks and means are not used."""
    both = {name: np.vstack([getattr(numbers, name), getattr(added, name)]) for name in OF_BASE}
    return SplatNumbers(blocks=added.blocks, **both)


def _expected_level(grid: GridSplats, detail: float, kept: int) -> Integers:
    """Return the numbers of the base's level of that detail, [kept, 4]; 0 if it has none."""
    expected = np.zeros((kept, 4), np.int32)
    own = grid.levels.get(detail)
    if own is not None:
        expected[: len(own)] = own[:kept]
    return expected


def _gaussians(grid: GridSplats, numbers: SplatNumbers, added: SplatNumbers) -> Gaussians:
    steps: Steps = grid.steps
    behind = gaussians_of(added, steps)
    shown = gaussians_of(numbers, steps, means_of_steps(numbers.means, grid.exponents))
    return joined(shown, behind)
