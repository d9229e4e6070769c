"""Tiles of a street: which field covers which area, as servers announce it to vehicles.

An area is a rectangle on the ground in the drives' own global frame (east, north, metres, float64);
its field may be used for ``margin_m`` beyond it, so that a neighbouring server can take over. A
server that publishes no tiles serves its fields everywhere.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from rfcore.errors import InvalidInput
from rfcore.wire.v1 import field_pb2 as pb
from rfcore.wire.values import check_field_id, check_label, check_name, check_range, same_named

MAX_TILES = 64
"""Tiles one server publishes."""
MAX_LIGHTS = 7
"""Lights of a tile, beside its own field: what both ends keep open."""
PREVIEW = "preview"
"""Reserved name: a small field of the tile's own light, with which vehicles begin while they fetch
the tile's own field."""


@dataclass(frozen=True)
class Area:
    """Ground from the south-west to the north-east corner, (east, north) in metres."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.low_m, *self.high_m))):
            raise InvalidInput("tile.area", f"{self.low_m} to {self.high_m} must be finite")
        if not (self.low_m[0] < self.high_m[0] and self.low_m[1] < self.high_m[1]):
            raise InvalidInput(
                "tile.area", f"{self.low_m} is not south-west of {self.high_m} (east, north)"
            )

    def distance_m(self, east_m: float, north_m: float) -> float:
        """Return how far outside a point is; 0 inside."""
        (west, south), (east, north) = self.low_m, self.high_m
        return math.hypot(
            max(west - east_m, 0.0, east_m - east), max(south - north_m, 0.0, north_m - north)
        )


@dataclass(frozen=True)
class TileLight:
    """Another field of a tile, of the street under light ``name``; version ``version`` of the tile.

    ``base_field_id`` is the field that it is a colour layer on, empty for a field of its own.
    ``passes`` is how many it was learnt from, ``time_of_day_h`` (UTC) when, None if not stated.
    """

    name: str
    field_id: str
    version: int
    base_field_id: str = ""
    passes: int = 0
    time_of_day_h: float | None = None

    def __post_init__(self) -> None:
        check_name("light.name", self.name)
        check_field_id("light.field_id", self.field_id)
        if self.base_field_id:
            check_field_id("light.base_field_id", self.base_field_id)
        if self.version < 1 or self.passes < 0:
            raise InvalidInput(
                "light", f"version {self.version} and {self.passes} passes must be 1 and 0 or more"
            )
        if self.time_of_day_h is not None:
            check_range("light.time_of_day_h", self.time_of_day_h, 0.0, 24.0)

    @property
    def field_ids(self) -> tuple[str, ...]:
        """The archives it takes: its base, if it is a layer, and its own."""
        return tuple(filter(None, (self.base_field_id, self.field_id)))


@dataclass(frozen=True)
class Tile:
    """A tile whose version ``version`` is field ``field_id``; without ``area`` it is everywhere.

    ``lights`` are fields of the same ground under other lights; a vehicle takes what fits best.
    """

    name: str
    field_id: str
    version: int = 1
    area: Area | None = None
    margin_m: float = 0.0
    lights: tuple[TileLight, ...] = ()

    def __post_init__(self) -> None:
        if len(self.lights) > MAX_LIGHTS:
            raise InvalidInput("tile.lights", f"{len(self.lights)} are more than {MAX_LIGHTS}")
        check_name("tile.name", self.name)
        check_field_id("tile.field_id", self.field_id)
        if self.version < 1:
            raise InvalidInput("tile.version", f"{self.version} is below 1")
        if not 0 <= self.margin_m < math.inf:
            raise InvalidInput("tile.margin_m", f"{self.margin_m} must be finite and not negative")

    @property
    def renderable_ids(self) -> tuple[str, ...]:
        """The fields that frames may refer to, the tile's own first."""
        return tuple(dict.fromkeys((self.field_id, *(light.field_id for light in self.lights))))

    @property
    def preview(self) -> TileLight | None:
        """The small field to begin with, if there is one."""
        return next((light for light in self.lights if light.name == PREVIEW), None)

    @property
    def other_lights(self) -> tuple[TileLight, ...]:
        """The fields under other lights than the tile's own."""
        return tuple(light for light in self.lights if light.name != PREVIEW)

    @property
    def archive_ids(self) -> frozenset[str]:
        """Every archive that belongs to the tile, the bases of layers too."""
        return frozenset((self.field_id, *(i for light in self.lights for i in light.field_ids)))

    def distance_m(self, east_m: float, north_m: float) -> float:
        """Return how far outside the tile's area a point is; 0 inside, and 0 everywhere without."""
        return 0.0 if self.area is None else self.area.distance_m(east_m, north_m)

    def reaches(self, east_m: float, north_m: float) -> bool:
        """Return whether the field may be used there: in the area or in the margin around it."""
        return self.distance_m(east_m, north_m) <= self.margin_m


@dataclass(frozen=True)
class LearntLight:
    """The field that a server learnt last for a light of a tile (empty for the tile's own).

    ``time_ms`` is in milliseconds of the Unix epoch. ``saved_ratio`` is the share of the bits that
    it saved on frames held back. It was ``withdrawn`` if it cost some vehicle more bits.
    """

    tile: str
    light: str
    field_id: str
    passes: int
    time_ms: int
    saved_ratio: float
    withdrawn: bool = False

    def __post_init__(self) -> None:
        check_name("learnt.tile", self.tile)
        check_label("learnt.light", self.light)
        check_field_id("learnt.field_id", self.field_id)
        check_range("learnt.saved_ratio", self.saved_ratio, -1e6, 1.0)


def learnt_message(learnt: LearntLight) -> pb.LearntLight:
    """Return what was learnt as protobuf."""
    return pb.LearntLight(**asdict(learnt))


def learnt_of(message: pb.LearntLight) -> LearntLight:
    """Return what a server says it learnt; raise ``InvalidInput`` naming what is wrong with it."""
    return same_named(LearntLight, message)


def tile_message(tile: Tile) -> pb.Tile:
    """Return a tile as protobuf."""
    message = pb.Tile(
        name=tile.name,
        field_id=tile.field_id,
        version=tile.version,
        margin_m=tile.margin_m,
        lights=[pb.TileLight(**asdict(light)) for light in tile.lights],
    )
    if tile.area is not None:
        message.area.CopyFrom(
            pb.Area(
                west_m=tile.area.low_m[0],
                south_m=tile.area.low_m[1],
                east_m=tile.area.high_m[0],
                north_m=tile.area.high_m[1],
            )
        )
    return message


def tile_of(message: pb.Tile) -> Tile:
    """Return a received tile; raise ``InvalidInput`` naming what is wrong with it."""
    area = None
    if message.HasField("area"):
        sides = message.area
        area = Area((sides.west_m, sides.south_m), (sides.east_m, sides.north_m))
    if len(message.lights) > MAX_LIGHTS:
        raise InvalidInput("tile.lights", f"{len(message.lights)} are more than {MAX_LIGHTS}")
    lights = tuple(map(_light_of, message.lights))
    return Tile(message.name, message.field_id, message.version, area, message.margin_m, lights)


def _light_of(message: pb.TileLight) -> TileLight:
    hour = message.time_of_day_h if message.HasField("time_of_day_h") else None
    return same_named(TileLight, message, time_of_day_h=hour)
