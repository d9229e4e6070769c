"""Splats as the content of an archive: raw, or compressed and decoded to the same bytes everywhere.

Raw: float32 arrays by the names of ``Gaussians``, followed by scales and opacities of lower levels,
``detail_50.log_scales`` and ``detail_50.opacity_logits``, likewise for 25 and 10.

Compressed: the header has an ``encoding``, {"name": "grid-2", "count", "sh_degree", "steps",
"streams"}; each array of the archive is one stream of ``rfcore.field.integers``, holding the
numbers of ``rfcore.field.splat_grid``. The field id is of the archive, so both ends decode one set
of splats. They are stored in bands: the first tenth, up to a quarter, up to half, the rest. Each
band has its own streams, ``10.means`` and so on, followed by the scales and opacities of the level
of detail that ends there, ``detail_10``. So the first bytes of a file are enough to draw its lowest
level (``detail_ends``). Within a band splats lie along a Morton curve, so that neighbours share a
block.

The first sample takes 20 bytes a splat, 8 % of the raw form, at a loss of 0.05 dB.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.field.archive import RAISE_LIMIT, Archive, Array, check_array_bytes
from rfcore.field.importance import reordered
from rfcore.field.integers import Columns, Integers, encode_columns, open_columns
from rfcore.field.interface import SPLATS, Bounds, FieldMetadata, stored_metadata
from rfcore.field.quality import (
    DETAILS,
    Beginning,
    LevelOfDetail,
    LevelsOfDetail,
    kept_of,
    splats_in,
)
from rfcore.field.splat_grid import (
    BLOCK,
    FINEST,
    Grain,
    SplatNumbers,
    Steps,
    gaussians_of,
    level_numbers_of,
    level_of,
    numbers_of,
    placed,
)
from rfcore.files import DECODED_BYTES
from rfcore.raster.gaussians import MAX_GAUSSIANS, Gaussians, empty_arrays, sky_of

SPLATS_AT_ONCE = 1 << 16
"""Splats that are decoded together, few enough to take little memory; a multiple of BLOCK."""

ENCODING = "grid-2"
ASCENDING = tuple(reversed(DETAILS))
MORTON_BITS = 21
SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that put two zeros after each of 21 bits."""


def compressed_archive(
    gaussians: Gaussians,
    levels: LevelsOfDetail,
    metadata: FieldMetadata,
    steps: Steps | None = None,
    grain: Grain = FINEST,
) -> Archive:
    """Return the compressed archive of the nearest splats on the grid.

    ``grain``: how finely they are placed. Raises ``InvalidInput`` for values that no grid holds;
    such a field has to be saved uncompressed.
    """
    chosen = steps if steps is not None else Steps()
    order = _local_order(gaussians)
    sorted_splats = reordered(gaussians, order)
    own = {detail: _reordered_level(level, order) for detail, level in levels.items()}
    numbers = [
        (band, numbers_of(splats_in(sorted_splats, band.part), chosen, grain))
        for band in _bands(len(gaussians))
    ]
    coded = {name: encode_columns(part) for name, part in _stored(numbers, own, chosen)}
    means = [gaussians_of(of_band, chosen).means for _, of_band in numbers]
    encoding = {
        "name": ENCODING,
        "count": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "steps": asdict(chosen),
        "streams": {name: header for name, (header, _) in coded.items()},
    }
    arrays: dict[str, Array] = {name: stream for name, (_, stream) in coded.items()}
    described = stored_metadata(metadata, Bounds.around(np.concatenate(means)))
    return Archive(SPLATS, {**described, "encoding": encoding}, arrays)


@dataclass(frozen=True)
class _Band:
    """Splats whose streams are stored together; the level ``detail`` draws up to these."""

    prefix: str
    part: slice
    detail: float

    @property
    def names(self) -> Mapping[str, str]:
        """The streams of its numbers, by the names of ``SplatNumbers``."""
        return {f.name: f"{self.prefix}{f.name}" for f in fields(SplatNumbers)}


def _bands(count: int) -> Sequence[_Band]:
    ends = [kept_of(count, detail) for detail in ASCENDING]
    return tuple(
        _Band(f"{round(detail * 100)}.", slice(start, end), detail)
        for detail, start, end in zip(ASCENDING, [0, *ends], ends, strict=False)
    )


def _level_in(level: LevelOfDetail, part: slice) -> LevelOfDetail:
    return LevelOfDetail(level.log_scales[part], level.opacity_logits[part])


def _stored(
    numbers: Sequence[tuple[_Band, SplatNumbers]], levels: LevelsOfDetail, steps: Steps
) -> Iterator[tuple[str, Integers]]:
    """Yield the numbers of each stream in the order of the file."""
    for index, (band, of_band) in enumerate(numbers):
        for field, name in band.names.items():
            yield name, getattr(of_band, field)
        if band.detail in levels:
            level = levels[band.detail]
            own = [
                level_numbers_of(_level_in(level, below.part), of_below, steps)
                for below, of_below in numbers[: index + 1]
            ]
            yield level_name(band.detail), np.vstack(own)


def splats_of_compressed(
    archive: Archive, max_bytes: int = DECODED_BYTES
) -> tuple[Gaussians, LevelsOfDetail]:
    """Return the splats of a compressed archive, which take ``max_bytes`` at most.

    Raises ``InvalidInput``, ``KeyError`` or ``TypeError`` for a damaged or larger one; every size
    is checked before it is allocated. Decoding takes a quarter of the splats' memory in addition.
    """
    stored = _Stored.of(archive, max_bytes)
    if set(stored.shapes) != set(archive.arrays):
        raise InvalidInput("encoding", f"arrays {', '.join(archive.arrays)} are not its streams")
    return stored.splats(stored.bands)


def splats_of_beginning(
    archive: Archive, max_bytes: int = DECODED_BYTES
) -> tuple[Gaussians, LevelsOfDetail, Beginning]:
    """Return the splats of the highest level of detail that the first arrays of a compressed
    archive hold, the levels up to it, and which part of the field they are.

    Raises as ``splats_of_compressed``, and ``InvalidInput`` if no level is there.
    """
    stored = _Stored.of(archive, max_bytes)
    bands = tuple(takewhile(stored.is_there, stored.bands))
    if not bands:
        raise InvalidInput("archive", "no level of detail is there yet")
    gaussians, levels = stored.splats(bands)
    return gaussians, levels, Beginning(stored.bands[-1].part.stop, bands[-1].detail)


@dataclass(frozen=True)
class GridSplats:
    """The integers of a compressed archive: ``numbers`` of all splats in the file's order, without
    blocks and with means as steps of ``2^exponents`` [N]; ``levels`` [K, 4] by detail."""

    numbers: SplatNumbers
    exponents: Integers
    levels: Mapping[float, Integers]
    steps: Steps
    sh_degree: int


def grid_splats(archive: Archive) -> GridSplats:
    """Return the numbers of a compressed archive; raises as ``splats_of_compressed``."""
    return _Stored.of(archive, DECODED_BYTES).grid()


def detail_ends(ends: Mapping[str, int]) -> Mapping[float, int]:
    """Return how many bytes of a file each level of detail needs; ``ends`` of its arrays as
    ``archive.array_ends`` returns them."""
    needed = {}
    for band in _bands(0):
        names = list(band.names.values())
        if set(names) <= set(ends):
            last = level_name(band.detail) if level_name(band.detail) in ends else names[-1]
            needed[band.detail] = ends[last]
    return needed


@dataclass(frozen=True)
class _Stored:
    """A compressed archive: its bands, and the rows and columns that each stream must have."""

    archive: Archive
    bands: Sequence[_Band]
    shapes: Mapping[str, tuple[int, int]]
    sh_degree: int
    steps: Steps

    @classmethod
    def of(cls, archive: Archive, max_bytes: int) -> _Stored:
        """Check the header; raises as ``splats_of_compressed``."""
        encoding = archive.metadata["encoding"]
        if encoding["name"] != ENCODING:
            raise InvalidInput("encoding", f"{encoding['name']!r} is not '{ENCODING}'")
        count = _whole(encoding, "count", MAX_GAUSSIANS)
        sh_degree = _whole(encoding, "sh_degree", 3)
        check_decoded_size(count, sh_degree, max_bytes)
        bands = _bands(count)
        levels = {level_name(detail): (kept_of(count, detail), 4) for detail in DETAILS[1:]}
        shapes = _shapes(bands, sh_degree) | {
            level: shape for level, shape in levels.items() if level in encoding["streams"]
        }
        return cls(archive, bands, shapes, sh_degree, Steps(**encoding["steps"]))

    def is_there(self, band: _Band) -> bool:
        """Return whether a band and the level that ends with it can be decoded."""
        level = level_name(band.detail)
        needed = {*band.names.values(), *({level} & set(self.shapes))}
        return needed <= set(self.archive.arrays)

    def splats(self, bands: Sequence[_Band]) -> tuple[Gaussians, LevelsOfDetail]:
        """Return the splats of ``bands``, which are the first ones, and the levels of those."""
        numbers = [(band, self._columns(band)) for band in bands]
        levels = {
            detail: self._level(level_name(detail), numbers)
            for detail in DETAILS[1:]
            if level_name(detail) in self.shapes and detail <= bands[-1].detail
        }
        return self._gaussians(numbers), levels

    def grid(self) -> GridSplats:
        """Return all stored numbers."""
        parts = [of_part for _, of_part in _in_parts([(b, self._columns(b)) for b in self.bands])]
        parts = parts or [_no_numbers(self.sh_degree)]
        means, exponents = zip(*map(placed, parts), strict=True)
        joined = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(SplatNumbers)
        }
        numbers = SplatNumbers(
            **{**joined, "blocks": np.zeros((0, 4), np.int32), "means": np.concatenate(means)}
        )
        levels = {
            detail: self._opened(level_name(detail)).rows(slice(None))
            for detail in DETAILS[1:]
            if level_name(detail) in self.shapes
        }
        exponent = np.concatenate(exponents)
        return GridSplats(numbers, exponent, levels, self.steps, self.sh_degree)

    def _opened(self, name: str) -> Columns:
        streams = self.archive.metadata["encoding"]["streams"]
        return open_columns(streams[name], self.archive.arrays[name], self.shapes[name])

    def _columns(self, band: _Band) -> Mapping[str, Columns]:
        return {field: self._opened(name) for field, name in band.names.items()}

    def _gaussians(self, numbers: Sequence[tuple[_Band, Mapping[str, Columns]]]) -> Gaussians:
        arrays = empty_arrays(numbers[-1][0].part.stop, self.sh_degree)
        for part, of_part in _in_parts(numbers):
            some = gaussians_of(of_part, self.steps)
            for name, array in arrays.items():
                array[part] = getattr(some, name)
        return Gaussians(**arrays)

    def _level(
        self, name: str, numbers: Sequence[tuple[_Band, Mapping[str, Columns]]]
    ) -> LevelOfDetail:
        own = self._opened(name)
        kept = len(own)
        level = LevelOfDetail(np.empty((kept, 3), np.float32), np.empty(kept, np.float32))
        for part, of_part in _in_parts(numbers):
            if part.start >= kept:
                break
            mine = slice(part.start, min(part.stop, kept))
            some = level_of(own.rows(mine), of_part, self.steps)
            level.log_scales[mine] = some.log_scales
            level.opacity_logits[mine] = some.opacity_logits
        return level


def _no_numbers(sh_degree: int) -> SplatNumbers:
    shapes = stream_shapes(0, sh_degree)
    return SplatNumbers(**{name: np.zeros(shape, np.int32) for name, shape in shapes.items()})


def _in_parts(
    numbers: Sequence[tuple[_Band, Mapping[str, Columns]]],
) -> Iterator[tuple[slice, SplatNumbers]]:
    """Yield slices of the splats with their numbers; each slice starts with a block."""
    for band, columns in numbers:
        first, count = band.part.start, band.part.stop - band.part.start
        for start in range(0, count, SPLATS_AT_ONCE):
            stop = min(start + SPLATS_AT_ONCE, count)
            rows = {field: slice(start, stop) for field in columns}
            rows["blocks"] = slice(start // BLOCK, -(-stop // BLOCK))
            of_part = {field: column.rows(rows[field]) for field, column in columns.items()}
            yield slice(first + start, first + stop), SplatNumbers(**of_part)


def check_decoded_size(count: int, sh_degree: int, max_bytes: int) -> None:
    """Raise ``InvalidInput`` if so many splats take more than ``max_bytes`` as float32."""
    size_bytes = 4 * count * (11 + 3 * (sh_degree + 1) ** 2)
    if size_bytes > max_bytes:
        raise InvalidInput(
            "splats",
            f"{count} of SH degree {sh_degree} take {size_bytes / 1e9:.2f} GB of memory, over the "
            f"limit of {max_bytes / 1e9:.2f} GB; {RAISE_LIMIT}",
        )


def stream_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, int]]:
    """Return rows and columns of the streams of ``count`` splats."""
    return {
        "blocks": (-(-count // BLOCK), 4),
        "means": (count, 3),
        "rotations": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count, 1),
        "sh": (count, 3 * (sh_degree + 1) ** 2),
    }


def _shapes(bands: Sequence[_Band], sh_degree: int) -> dict[str, tuple[int, int]]:
    return {
        f"{band.prefix}{name}": shape
        for band in bands
        for name, shape in stream_shapes(band.part.stop - band.part.start, sh_degree).items()
    }


def _whole(encoding: Mapping[str, Any], key: str, highest: int) -> int:
    value = encoding[key]
    if type(value) is not int or not 0 <= value <= highest:
        raise InvalidInput(f"encoding.{key}", f"{value!r} is not a whole number 0..{highest}")
    return value


def level_name(detail: float) -> str:
    """Return the name of the stream of a level of detail."""
    return f"detail_{round(detail * 100)}"


def _reordered_level(level: LevelOfDetail, order: NDArray[np.intp]) -> LevelOfDetail:
    """Return the level in the field's new order, which leaves every splat in its band."""
    own = order[: len(level.opacity_logits)]
    return replace(
        level, log_scales=level.log_scales[own], opacity_logits=level.opacity_logits[own]
    )


def _local_order(gaussians: Gaussians) -> NDArray[np.intp]:
    """Return the order [N] along the curve within each band, with the sky last, since a block that
    held both would have coarse steps."""
    n = len(gaussians)
    band = np.zeros(n, np.int8)
    for detail in DETAILS[1:]:
        band[kept_of(n, detail) :] += 1
    is_sky = sky_of(gaussians.means)
    curve = np.zeros(n, np.uint64)
    for part in (is_sky, ~is_sky):
        curve[part] = _morton(gaussians.means[part].astype(np.float64))
    return np.lexsort((curve, is_sky, band))


def _morton(means: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the positions of points [N, 3] on the Morton curve through the cube around them."""
    if not len(means):
        return np.zeros(0, np.uint64)
    low = means.min(axis=0)
    side = max(float((means.max(axis=0) - low).max()), np.finfo(np.float64).tiny)
    cells = ((means - low) / side * (2**MORTON_BITS - 1)).astype(np.uint64)
    for shift, mask in SPREAD:
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.asarray(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)))


NAMES = tuple(f.name for f in fields(Gaussians))
LEVEL_NAMES = tuple(f.name for f in fields(LevelOfDetail))


def splat_archive(gaussians: Gaussians, levels: LevelsOfDetail, metadata: FieldMetadata) -> Archive:
    """Return the raw archive of ``gaussians`` and their ``levels``."""
    arrays: dict[str, Array] = {name: getattr(gaussians, name) for name in NAMES}
    for detail in DETAILS:
        if detail in levels:
            own = {_own(detail, name): getattr(levels[detail], name) for name in LEVEL_NAMES}
            arrays.update(own)
    return Archive(SPLATS, stored_metadata(metadata, Bounds.around(gaussians.means)), arrays)


def splats_of_archive(
    archive: Archive, max_bytes: int = DECODED_BYTES
) -> tuple[Gaussians, LevelsOfDetail]:
    """Return the content of an archive, raw or compressed.

    Raises ``InvalidInput`` if it does not hold splats; see also ``splats_of_compressed``. Those of
    a raw archive take no memory beside the file's, and ``max_bytes`` of it at most.
    """
    if "encoding" in archive.metadata:
        return splats_of_compressed(archive, max_bytes)
    check_array_bytes(archive, sum(a.nbytes for a in archive.arrays.values()), max_bytes)
    arrays = dict(archive.arrays)
    levels = {
        detail: LevelOfDetail(*(arrays.pop(_own(detail, name)) for name in LEVEL_NAMES))
        for detail in DETAILS[1:]
        if all(_own(detail, name) in arrays for name in LEVEL_NAMES)
    }
    if set(arrays) != set(NAMES):
        raise InvalidInput("archive", f"arrays {', '.join(archive.arrays)} are not splats")
    return Gaussians(**arrays), levels


def _own(detail: float, name: str) -> str:
    return f"detail_{round(detail * 100)}.{name}"
