"""Convert a dataset of any format into pinhole pictures with a ``transforms.json``, or into tiles.

Tiles overlap: each is a dataset, and ``tiles.json`` lists them. The ground below the cameras,
axis-parallel in the dataset's own world (x east, y north), is cut into equal rectangles whose sides
are at most ``length_m``. A tile takes every picture that was taken on its rectangle or within half
the overlap of it: each picture is in at least one tile, and those along a border are in the tiles
of both sides. Rectangles without pictures are no tiles.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.dataset import Dataset, Distortion, ReadOptions, read_dataset
from rfcore.dataset.assemble import assemble
from rfcore.dataset.bag_file import is_bag
from rfcore.dataset.read import read_source
from rfcore.dataset.source import SourceCamera, SourcePoints
from rfcore.dataset.write import WrittenPicture, write_transforms
from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import whole_folder, write_whole
from rfcore.image import write_png
from rfcore.views import PosedPicture


def convert_dataset(
    path: Path,
    out: Path,
    size_px: tuple[int, int] | None,
    chosen: slice = slice(None),
    topics: tuple[str, ...] = (),
) -> str:
    """Write ``out``; return a line about it, and one for each thing done to the pictures.

    Pictures are undistorted and reduced once; poses and points keep the dataset's own world.
    ``topics`` are those of a bag that are meant; its pose feeds are written, too.
    Raises ``InvalidInput`` when ``out`` exists, ``DatasetError`` naming what is wrong in ``path``.
    """
    start, step = (1 if n is None else n for n in (chosen.start, chosen.step))
    if step < 1 or start < 0:
        raise InvalidInput("every", "must be at least 1, and the offset at least 0")
    if not is_bag(path) and topics:
        raise InvalidInput("topics", f"belong to a bag, which {path} is not")
    options = ReadOptions(distortion=Distortion.UNDISTORT, size_px=size_px)
    source = read_source(path, topics)
    dataset = assemble(source, options)
    count, dataset = len(dataset.pictures), replace(dataset, pictures=dataset.pictures[chosen])
    if not dataset.pictures:
        raise InvalidInput("offset", f"leaves none of the {count} pictures")
    with whole_folder(out) as folder:
        write_in_own_world(folder, dataset, enumerate(dataset.pictures), global_points(dataset))
        feeds = [_write_feed(folder, *feed) for feed in source.feeds.items()]
    return "\n".join([f"{out}: {len(dataset.pictures)} pictures", *dataset.changes, *feeds])


def _write_feed(folder: Path, topic: str, lines: Sequence[str]) -> str:
    name = topic.strip("/").replace("/", "_") + ".jsonl"
    write_whole(folder / name, "".join(f"{line}\n" for line in lines))
    return f"{name} there: {len(lines)} poses of {topic}, for cav-agent --pose-feed file:{name}"


def write_in_own_world(
    folder: Path,
    dataset: Dataset,
    numbered: Iterable[tuple[int, PosedPicture]],
    points: SourcePoints | None,
) -> None:
    """Write pictures, points and anchor of a dataset in its own world, without a tile's origin.

    The pictures are named by their numbers.
    """
    (folder / "images").mkdir(parents=True)
    timed = any(picture.time_ns for picture in dataset.pictures)
    origin, anchor = dataset.tile_origin, dataset.anchor
    written = []
    for number, picture in numbered:
        name = f"images/{number:06d}.png"
        write_png(folder / name, picture.read())
        mask_path = None
        if (mask := picture.read_mask()) is not None:
            (folder / "masks").mkdir(exist_ok=True)
            mask_path = f"masks/{number:06d}.png"
            write_png(folder / mask_path, np.where(mask[..., None], LEARNT, HIDDEN))
        written.append(
            WrittenPicture(
                file_path=name,
                camera=SourceCamera(picture.camera.intrinsics),
                world_from_cam=origin.globalise(picture.camera.world_from_cam),
                time_ns=picture.time_ns if timed else None,
                mask_path=mask_path,
            )
        )
    if anchor is not None:
        anchor = anchor.relative_to(TileOrigin(-origin.east_m, -origin.north_m, -origin.up_m))
    write_transforms(folder, written, points, anchor)


def global_points(dataset: Dataset) -> SourcePoints | None:
    """Return the points in the dataset's own world."""
    if dataset.points is None:
        return None
    xyz_m = dataset.points.xyz_m + np.array(astuple(dataset.tile_origin))
    return SourcePoints(xyz_m, dataset.points.rgb)


LEARNT, HIDDEN = np.full(3, 255, np.uint8), np.zeros(3, np.uint8)
"""Colours of a mask's pixels."""
LIST_NAME = "tiles.json"
MOST_TILES = 1000
LEAST_SIDE_M = 1.0
"""Least width of the ground of a recording along a straight line."""
Area = tuple[float, float, float, float]
"""West, south, east and north side, m."""


@dataclass(frozen=True)
class SplitSettings:
    """Options of a split."""

    length_m: float
    """Longest side of a tile's ground."""
    overlap_m: float
    """Width of the ground whose pictures two neighbouring tiles share."""
    fewest: int = 8
    """Least number of pictures of a tile."""
    points_m: float = 60.0
    """A tile takes the dataset's points on its ground and within this distance of it."""

    def __post_init__(self) -> None:
        if not 0 < self.length_m < math.inf:
            raise InvalidInput("length", f"{self.length_m:g} m must be above 0 and finite")
        if not 0 <= self.overlap_m <= self.length_m:
            raise InvalidInput(
                "overlap", f"{self.overlap_m:g} m is outside 0..{self.length_m:g} m, the length"
            )
        if self.fewest < 1:
            raise InvalidInput("fewest", f"{self.fewest} must be at least 1 picture")
        if not self.points_m >= 0:
            raise InvalidInput("points", f"{self.points_m:g} m must be at least 0")


@dataclass(frozen=True)
class SplitTile:
    """A tile: its ground in the dataset's own world, and what is on it."""

    name: str
    area_m: Area
    margin_m: float
    """Distance beyond its ground that its pictures reach."""
    pictures: tuple[int, ...]
    """Indices in the recording."""
    neighbours: tuple[str, ...]
    """Tiles whose grounds touch this one's, corners included."""


def tiles_of(ground_m: NDArray[np.float64], settings: SplitSettings) -> tuple[SplitTile, ...]:
    """Return the tiles of cameras at ``ground_m`` [N, 2], from west to east, south to north.

    Raises ``InvalidInput`` for more than ``MOST_TILES``, and naming a tile with too few pictures.
    """
    low_m, high_m = _sides(ground_m)
    cells = np.maximum(np.ceil((high_m - low_m) / settings.length_m - 1e-9), 1.0)
    if cells.prod() > MOST_TILES:
        raise InvalidInput(
            "length",
            f"{settings.length_m:g} m makes {cells.prod():.0f} tiles of the recording's ground, "
            f"the limit is {MOST_TILES}; take a greater length",
        )
    side_m = (high_m - low_m) / cells
    own = np.minimum((ground_m - low_m) // side_m, cells - 1).astype(int)
    margin_m = settings.overlap_m / 2
    tiles = []
    there = sorted({(int(x), int(y)) for x, y in own})
    for x, y in there:
        west_south = low_m + side_m * (x, y)
        east_north = west_south + side_m
        near = (ground_m >= west_south - margin_m) & (ground_m <= east_north + margin_m)
        inside = near.all(axis=1) | (own == (x, y)).all(axis=1)
        around = [(x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
        tile = SplitTile(
            name=_name(x, y),
            area_m=_area(west_south, east_north),
            margin_m=margin_m,
            pictures=tuple(int(i) for i in np.flatnonzero(inside)),
            neighbours=tuple(_name(*cell) for cell in around if cell in there),
        )
        _require_pictures(tile, settings)
        tiles.append(tile)
    return tuple(tiles)


def _sides(ground_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the south-western and the north-eastern corner, at least ``LEAST_SIDE_M`` apart."""
    low_m, high_m = ground_m.min(axis=0), ground_m.max(axis=0)
    missing_m = np.maximum(LEAST_SIDE_M - (high_m - low_m), 0.0)
    return low_m - missing_m / 2, high_m + missing_m / 2


def _name(x: int, y: int) -> str:
    return f"tile-{x}-{y}"


def _area(west_south: NDArray[np.float64], east_north: NDArray[np.float64]) -> Area:
    (west, south), (east, north) = west_south.tolist(), east_north.tolist()
    return west, south, east, north


def _require_pictures(tile: SplitTile, settings: SplitSettings) -> None:
    if len(tile.pictures) < settings.fewest:
        raise InvalidInput(
            "length",
            f"{settings.length_m:g} m leaves {tile.name} {len(tile.pictures)} pictures, it needs "
            f"{settings.fewest}; take another length or overlap, or a smaller --fewest",
        )


def split_dataset(path: Path, out: Path, settings: SplitSettings) -> tuple[SplitTile, ...]:
    """Write a dataset a tile into the new folder ``out``, and ``tiles.json``; return the tiles.

    Pictures are undistorted; poses and points keep the dataset's own world. Raises ``InvalidInput``
    when ``out`` exists and as ``tiles_of``, ``DatasetError`` naming what is wrong in ``path``.
    """
    dataset = read_dataset(path, distortion="undistort")
    origin_m = np.array(astuple(dataset.tile_origin))
    places = [picture.camera.world_from_cam.translation_m for picture in dataset.pictures]
    tiles = tiles_of(np.array(places)[:, :2] + origin_m[:2], settings)
    with whole_folder(out) as folder:
        origins = [_write_tile(folder / tile.name, dataset, tile, settings) for tile in tiles]
        listed = [_listed(tile, at) for tile, at in zip(tiles, origins, strict=True)]
        write_whole(folder / LIST_NAME, json.dumps({"tiles": listed}, indent=1) + "\n")
    return tiles


def _write_tile(
    folder: Path, dataset: Dataset, tile: SplitTile, settings: SplitSettings
) -> TileOrigin:
    """Write a tile's dataset; return the origin that readers choose for it."""
    numbered = ((i, dataset.pictures[i]) for i in tile.pictures)
    points = _points_near(dataset, tile.area_m, settings.points_m)
    write_in_own_world(folder, dataset, numbered, points)
    return read_dataset(folder).tile_origin


def _points_near(dataset: Dataset, area_m: Area, within_m: float) -> SourcePoints | None:
    points = global_points(dataset)
    if points is None:
        return None
    low_m, high_m = np.array(area_m[:2]) - within_m, np.array(area_m[2:]) + within_m
    near = ((points.xyz_m[:, :2] >= low_m) & (points.xyz_m[:, :2] <= high_m)).all(axis=1)
    return SourcePoints(points.xyz_m[near], points.rgb[near]) if near.any() else None


def _listed(tile: SplitTile, origin: TileOrigin) -> dict[str, Any]:
    return {
        "id": tile.name,
        "area_m": list(tile.area_m),
        "margin_m": tile.margin_m,
        "tile_origin_m": list(astuple(origin)),
        "pictures": list(tile.pictures),
        "neighbours": list(tile.neighbours),
    }


def read_tiles(folder: Path) -> tuple[SplitTile, ...] | None:
    """Return the tiles that ``tiles.json`` of a folder lists; None where there is no such file.

    Raises ``DatasetError`` for a list that ``split_dataset`` cannot have written.
    """
    file = folder / LIST_NAME
    if not file.is_file():
        return None
    try:
        tiles = tuple(_tile(entry) for entry in json.loads(file.read_text("utf-8"))["tiles"])
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{file}: is no list of tiles ({error!r}); split again") from error
    _require_names(file, tiles)
    return tiles


def _tile(entry: dict[str, Any]) -> SplitTile:
    west, south, east, north = (float(side) for side in entry["area_m"])
    return SplitTile(
        name=str(entry["id"]),
        area_m=(west, south, east, north),
        margin_m=float(entry["margin_m"]),
        pictures=tuple(int(i) for i in entry["pictures"]),
        neighbours=tuple(str(name) for name in entry["neighbours"]),
    )


def _require_names(file: Path, tiles: Sequence[SplitTile]) -> None:
    names = [tile.name for tile in tiles]
    odd = [name for name in names if not name or Path(name).name != name or names.count(name) > 1]
    if odd or not names:
        raise DatasetError(f"{file}: {odd or 'no tiles'}: names must be there, single and plain")
