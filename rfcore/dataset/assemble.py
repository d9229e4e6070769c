"""Turn what a reader found into pinhole pictures around an origin, for trainers and vehicles.

The tile's origin is subtracted in float64. A lens is never dropped silently: with
``Distortion.UNDISTORT`` every read resamples the picture once, otherwise it is refused.

Pictures are reduced by area averaging: each output pixel is the mean of the input rectangle it
covers, so that nothing aliases. Its intrinsics are exactly ``Intrinsics.resized``, because pixel
centres are at +0.5. A size of another shape takes the middle of the pictures: nothing is squashed.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.dataset.keys import blamed_on
from rfcore.dataset.source import Source, SourcePicture, SourcePoints
from rfcore.dataset.undistort import pinhole_of, undistorted
from rfcore.errors import DatasetError, InvalidInput
from rfcore.geodesy import Anchor
from rfcore.image import Rgb
from rfcore.views import Mask, PointCloud, PosedPicture


def check_reduction(name: str, from_px: tuple[int, int], to_px: tuple[int, int]) -> None:
    """Raise ``InvalidInput`` unless ``to_px`` (width, height) is 1 px or more and no larger."""
    if min(to_px) < 1 or to_px[0] > from_px[0] or to_px[1] > from_px[1]:
        raise InvalidInput(
            "size_px",
            f"{to_px[0]}x{to_px[1]} is outside 1x1..{from_px[0]}x{from_px[1]}, the size of {name}",
        )


LEAST_KEPT = 0.5
"""Share of a picture that a size of another shape must leave."""


def middle_of_shape(
    name: str, from_px: tuple[int, int], to_px: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the largest middle part that has ``to_px``'s shape.

    Raises ``InvalidInput`` where that is less than half of the picture.
    """
    (width, height), (to_width, to_height) = from_px, to_px
    part = (
        min(width, max(1, round(height * to_width / to_height))),
        min(height, max(1, round(width * to_height / to_width))),
    )
    kept = part[0] * part[1] / (width * height)
    if kept < LEAST_KEPT:
        scale = max(to_px) / max(from_px)
        raise InvalidInput(
            "size",
            f"{to_width}x{to_height} has another shape than {name}, {width}x{height} px, of which "
            f"it leaves {kept:.0%}; {max(1, round(width * scale))}x{max(1, round(height * scale))} "
            "has the same shape",
        )
    return (width - part[0]) // 2, (height - part[1]) // 2, *part


def area_averaged(rgb: Rgb, width_px: int, height_px: int) -> Rgb:
    """Return uint8 [height, width, 3], rounded half up."""
    means = _averaged(_averaged(rgb.astype(np.float64), height_px, 0), width_px, 1)
    return np.floor(means + 0.5).astype(np.uint8)


def _averaged(values: NDArray[np.float64], count: int, axis: int) -> NDArray[np.float64]:
    """Average along one axis: differences of the running integral at the new pixels' edges."""
    size = values.shape[axis]
    if count == size:
        return values
    zero = np.zeros_like(np.take(values, [0], axis))
    integral = np.concatenate([zero, np.cumsum(values, axis)], axis)
    edges = np.arange(count + 1) * size / count
    before = np.minimum(edges.astype(int), size - 1)
    shape = [1] * values.ndim
    shape[axis] = -1
    share = (edges - before).reshape(shape)
    at_edges = np.take(integral, before, axis) + share * np.take(values, before, axis)
    return np.asarray(np.diff(at_edges, axis=axis) * (count / size))


MAX_TILE_RADIUS_M = 100_000.0
"""float32 positions resolve 8 mm at this distance from the tile's origin."""


class Distortion(StrEnum):
    """Whether pictures taken through a lens that distorts are refused or resampled."""

    REFUSE = "refuse"
    UNDISTORT = "undistort"


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading a dataset.

    ``tile_origin`` None stands for zero where the cameras are within 10 km of it, else for the
    median camera position rounded to whole metres. Pictures are reduced to ``size_px`` (width,
    height) if it is given, their middle part if it has another shape.
    """

    tile_origin: TileOrigin | None = None
    distortion: Distortion = Distortion.REFUSE
    size_px: tuple[int, int] | None = None


@dataclass(frozen=True)
class Dataset:
    """Posed pictures on disk, in the order of the file.

    ``rate_hz`` is the mean rate of the pictures' times, ``None`` unless every picture has one and
    they increase. ``points`` is ``None`` when the dataset has none. ``changed`` has the names of
    pictures by what reading does to them, ``notes`` what was chosen, a line each. ``sorted_out``
    counts those that are listed but were deleted as blurred (``rfcore.dataset.read``).
    ``exposure_varies`` is true where the dataset says that every picture has an exposure of its
    own. ``anchor`` says where on the Earth the tile's axes are, if the dataset does.
    """

    pictures: tuple[PosedPicture, ...]
    rate_hz: float | None
    points: PointCloud | None
    tile_origin: TileOrigin
    changed: Mapping[str, frozenset[str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    sorted_out: int = 0
    exposure_varies: bool = False
    anchor: Anchor | None = None

    @property
    def changes(self) -> tuple[str, ...]:
        """Lines that say what was chosen, and what reading does to the pictures, with their
        number."""
        names = [picture.name for picture in self.pictures]
        counts = {what: sum(map(those.__contains__, names)) for what, those in self.changed.items()}
        counted = (f"{n} of {len(names)} pictures {what}" for what, n in counts.items() if n)
        return (*self.notes, *counted)


def assemble(source: Source, options: ReadOptions) -> Dataset:
    """Return the dataset; pixels are read on demand.

    Raises ``DatasetError`` naming the file and the key for a lens that was not to be undistorted,
    times out of order, and cameras too far from the origin; ``InvalidInput`` for ``size_px``.
    """
    if not source.pictures:
        raise DatasetError(f"{source.file}: names no pictures")
    _check_times(source.pictures)
    origin = options.tile_origin or chosen_origin(source.pictures)
    times_ns = [picture.time_ns for picture in source.pictures if picture.time_ns is not None]
    timed = len(times_ns) == len(source.pictures)
    return Dataset(
        pictures=tuple(_posed(picture, origin, options) for picture in source.pictures),
        rate_hz=_rate_hz(times_ns) if timed else None,
        points=localised(source.points, origin) if source.points is not None else None,
        tile_origin=origin,
        changed=_changed(source.pictures, options.size_px),
        notes=(
            *source.notes,
            *([source.points.note] if source.points is not None and source.points.note else []),
        ),
        sorted_out=source.sorted_out,
        exposure_varies=source.exposure_varies,
        anchor=source.anchor.relative_to(origin) if source.anchor is not None else None,
    )


def _posed(picture: SourcePicture, origin: TileOrigin, options: ReadOptions) -> PosedPicture:
    intrinsics = _pinhole(picture, options.distortion)
    read = partial(_read, picture)
    if options.size_px is not None:
        size_px = (intrinsics.width_px, intrinsics.height_px)
        check_reduction(picture.where, size_px, options.size_px)
        part = middle_of_shape(picture.where, size_px, options.size_px)
        intrinsics = intrinsics.cropped(*part).resized(*options.size_px)
        read = partial(_read, picture, options.size_px)
    camera = Camera(intrinsics, _near(picture, origin))
    mask = None if picture.mask is None else partial(_mask, picture, picture.mask, options.size_px)
    return PosedPicture(picture.name, camera, read, picture.time_ns or 0, mask)


def _mask(
    picture: SourcePicture, read: Callable[[], Mask], size_px: tuple[int, int] | None
) -> Mask:
    """Return the pixels that come from counted ones alone."""
    levels = np.where(read()[..., None], np.uint8(255), np.uint8(0)).repeat(3, axis=2)
    return np.asarray(_resampled(picture, levels, size_px)[..., 0] == 255)


def _read(picture: SourcePicture, size_px: tuple[int, int] | None = None) -> Rgb:
    return _resampled(picture, picture.read(), size_px)


def _resampled(picture: SourcePicture, rgb: Rgb, size_px: tuple[int, int] | None) -> Rgb:
    lens = picture.camera.lens
    if lens is not None:
        rgb = undistorted(rgb, picture.camera.intrinsics, lens)
    if size_px is None:
        return rgb
    k = picture.camera.intrinsics
    left, top, width, height = middle_of_shape(picture.where, (k.width_px, k.height_px), size_px)
    return area_averaged(rgb[top : top + height, left : left + width], *size_px)


def _changed(
    pictures: Sequence[SourcePicture], size_px: tuple[int, int] | None
) -> dict[str, frozenset[str]]:
    """Return the names of pictures by what is done to them, after "N pictures"."""
    changed: dict[str, list[str]] = {}
    for picture in pictures:
        for note in picture.notes:
            changed.setdefault(note, []).append(picture.name)
        if picture.camera.lens is not None:
            changed.setdefault("are undistorted", []).append(picture.name)
    for picture in pictures:
        if size_px is None:
            break
        from_px = (picture.camera.intrinsics.width_px, picture.camera.intrinsics.height_px)
        _, _, *part = middle_of_shape("pictures", from_px, size_px)
        if tuple(part) != from_px:
            shapes = [f"{width}x{height}" for width, height in (from_px, part, size_px)]
            what = (
                f"are cropped from {shapes[0]} to {shapes[1]} px, "
                f"{part[0] * part[1] / (from_px[0] * from_px[1]):.0%} of them, which has the "
                f"shape of {shapes[2]}"
            )
            changed.setdefault(what, []).append(picture.name)
    return {what: frozenset(names) for what, names in changed.items()}


def _pinhole(picture: SourcePicture, distortion: Distortion) -> Intrinsics:
    lens = picture.camera.lens
    if lens is None:
        return picture.camera.intrinsics
    if distortion is Distortion.REFUSE:
        raise DatasetError(
            f"{picture.where}: lens distortion {lens}; write undistorted pictures once with "
            "`rfedge dataset convert`, or train with --undistort"
        )
    with blamed_on(picture.where):
        return pinhole_of(picture.camera.intrinsics, lens)


def _near(picture: SourcePicture, origin: TileOrigin) -> Pose:
    local = origin.localise(picture.world_from_cam)
    distance_m = math.hypot(*local.translation_m)
    if distance_m > MAX_TILE_RADIUS_M:
        raise DatasetError(
            f"{picture.where}: camera is {distance_m:.6g} m from the tile's origin, over "
            f"{MAX_TILE_RADIUS_M:g} m: the pictures are of another place than the field or tile"
        )
    return local


def chosen_origin(pictures: Sequence[SourcePicture]) -> TileOrigin:
    """Return zero where the cameras are near it, else their median position in whole metres."""
    axes = zip(*(picture.world_from_cam.translation_m for picture in pictures), strict=True)
    return TileOrigin.beside([statistics.median(axis) for axis in axes])


def localised(points: SourcePoints, origin: TileOrigin) -> PointCloud:
    """Return points relative to the tile's origin, subtracted in float64."""
    local_m = points.xyz_m - (origin.east_m, origin.north_m, origin.up_m)
    return PointCloud(local_m.astype(np.float32), points.rgb)


def _check_times(pictures: Sequence[SourcePicture]) -> None:
    """Raise ``DatasetError`` where time goes back; equal times are several cameras' pictures."""
    timed = [(p.where, p.time_ns) for p in pictures if p.time_ns is not None]
    for (_, before_ns), (where, after_ns) in pairwise(timed):
        if after_ns < before_ns:
            raise DatasetError(
                f"{where}: time {after_ns / 1e9:.9g} s comes after {before_ns / 1e9:.9g} s; put "
                "the pictures in order of time"
            )


def _rate_hz(times_ns: Sequence[int]) -> float | None:
    if len(times_ns) < 2 or any(b <= a for a, b in pairwise(times_ns)):
        return None
    return (len(times_ns) - 1) * 1e9 / (times_ns[-1] - times_ns[0])
