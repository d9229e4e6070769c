"""``tiles.json`` in a folder of fields: the versions of each tile, and which one is current.

The folder holds archives by content (``<sha256>.rff``), so publishing never changes a file that a
vehicle may be fetching; what is current is one name in the manifest, which is replaced as a whole.
A folder without the file publishes no tiles.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.files import write_whole
from rfcore.wire.checks import check_field_id, check_name
from rfcore.wire.tiles import MAX_TILES, Area, Tile, TileLight

__all__ = [
    "MANIFEST",
    "OWN_LIGHT",
    "Publication",
    "TileVersions",
    "VersionLabel",
    "read_publication",
    "write_publication",
]

MANIFEST = "tiles.json"
FORMAT = "rfedge tiles 1"


@dataclass(frozen=True)
class VersionLabel:
    """The light that a version was learnt under; empty for the tile's own field.

    The other values are as in ``TileLight``.
    """

    light: str = ""
    base_field_id: str = ""
    passes: int = 0
    time_of_day_h: float | None = None


OWN_LIGHT = VersionLabel()


@dataclass(frozen=True)
class TileVersions:
    """All versions of one tile, from number 1 on; ``times`` (ISO 8601) are when each was published.

    ``labels`` has one for each version, or none at all if all are the tile's own. ``current`` is
    the tile's own field, ``lights`` the current version of each other light.
    """

    field_ids: tuple[str, ...]
    times: tuple[str, ...]
    current: int
    area: Area | None = None
    margin_m: float = 0.0
    labels: tuple[VersionLabel, ...] = ()
    lights: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.labels and len(self.labels) != len(self.field_ids):
            raise InvalidInput("tile.versions", "not every version has its label")
        for name, number in {"": self.current, **self.lights}.items():
            is_there = 1 <= number <= len(self.field_ids)
            if is_there and self.label(number).light != name:
                raise InvalidInput("tile.lights", f"version {number} is not of light {name!r}")
            if not is_there and name:
                raise InvalidInput(
                    "tile.lights", f"{name!r} is version {number}, of {len(self.field_ids)}"
                )
        for field_id in self.field_ids:
            check_field_id("tile.versions", field_id)
        if len(self.times) != len(self.field_ids):
            raise InvalidInput("tile.versions", "not every version has its time")
        if not 1 <= self.current <= len(self.field_ids):
            raise InvalidInput(
                "tile.current", f"{self.current} is outside 1..{len(self.field_ids)}"
            )

    def label(self, number: int) -> VersionLabel:
        """Return the label of version ``number``."""
        return self.labels[number - 1] if self.labels else OWN_LIGHT

    def of_light(self, light: str) -> list[int]:
        """Return the numbers of the versions of a light, ascending; of the tile's own for ''."""
        numbers = range(1, len(self.field_ids) + 1)
        return [number for number in numbers if self.label(number).light == light]

    def with_version(self, field_id: str, time: str, label: VersionLabel) -> TileVersions:
        """Return these and one more version, which is the current one of its light."""
        number = len(self.field_ids) + 1
        labels = (*(self.label(n) for n in range(1, number)), label)
        field_ids, times = (*self.field_ids, field_id), (*self.times, time)
        return replace(self, field_ids=field_ids, times=times, labels=labels).having(
            label.light, number
        )

    def having(self, light: str, number: int | None) -> TileVersions:
        """Return these with another current version of a light; None withdraws the light."""
        if not light:
            return self if number is None else replace(self, current=number)
        others = {name: n for name, n in self.lights.items() if name != light}
        return replace(self, lights=others if number is None else {**others, light: number})

    def tile(self, name: str) -> Tile:
        """Return the current versions."""
        field_id = self.field_ids[self.current - 1]
        lights = tuple(self._light(name, n) for name, n in sorted(self.lights.items()))
        return Tile(name, field_id, self.current, self.area, self.margin_m, lights)

    def _light(self, name: str, number: int) -> TileLight:
        label = self.label(number)
        return TileLight(
            name,
            self.field_ids[number - 1],
            number,
            label.base_field_id,
            label.passes,
            label.time_of_day_h,
        )


@dataclass(frozen=True)
class Publication:
    """The tiles of one folder, by name."""

    tiles: Mapping[str, TileVersions]

    def __post_init__(self) -> None:
        if len(self.tiles) > MAX_TILES:
            raise InvalidInput("tiles", f"{len(self.tiles)} are more than {MAX_TILES}")
        for name, versions in self.tiles.items():
            check_name("tile.name", name)
            versions.tile(name)

    def current(self) -> tuple[Tile, ...]:
        """Return the current version of each tile, by name."""
        return tuple(versions.tile(name) for name, versions in sorted(self.tiles.items()))

    def having(self, name: str, versions: TileVersions) -> Publication:
        """Return a publication with tile ``name`` added or replaced."""
        return replace(self, tiles={**self.tiles, name: versions})


def read_publication(folder: Path) -> Publication:
    """Return what is published in ``folder``; raise ``FieldFormatError`` for a damaged manifest."""
    path = folder / MANIFEST
    if not path.exists():
        return Publication({})
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise FieldFormatError(f"{path}: format {content['format']!r} is not {FORMAT!r}")
        return Publication({name: _versions(tile) for name, tile in content["tiles"].items()})
    except (ValueError, KeyError, TypeError, AttributeError, InvalidInput) as error:
        raise FieldFormatError(f"{path}: {type(error).__name__} {error}") from error


def write_publication(folder: Path, publication: Publication) -> None:
    """Replace the manifest of ``folder`` as a whole. Raises ``OSError``."""
    tiles = {name: _stored(versions) for name, versions in sorted(publication.tiles.items())}
    write_whole(folder / MANIFEST, json.dumps({"format": FORMAT, "tiles": tiles}, indent=1) + "\n")


def _versions(stored: Mapping[str, Any]) -> TileVersions:
    area = stored["area"]
    return TileVersions(
        field_ids=tuple(str(version["field_id"]) for version in stored["versions"]),
        times=tuple(str(version["published"]) for version in stored["versions"]),
        current=int(stored["current"]),
        area=None if area is None else Area(_corner(area["low_m"]), _corner(area["high_m"])),
        margin_m=float(stored["margin_m"]),
        labels=tuple(_label(version) for version in stored["versions"]),
        lights={str(name): int(number) for name, number in stored.get("lights", {}).items()},
    )


def _label(version: Mapping[str, Any]) -> VersionLabel:
    hour = version.get("time_of_day_h")
    return VersionLabel(
        str(version.get("light", "")),
        str(version.get("base_field_id", "")),
        int(version.get("passes", 0)),
        None if hour is None else float(hour),
    )


def _corner(stored: Any) -> tuple[float, float]:
    east_m, north_m = (float(value) for value in stored)
    return east_m, north_m


def _stored(versions: TileVersions) -> dict[str, Any]:
    area = versions.area
    return {
        "area": None if area is None else {"low_m": area.low_m, "high_m": area.high_m},
        "margin_m": versions.margin_m,
        "current": versions.current,
        "lights": dict(sorted(versions.lights.items())),
        "versions": [
            {"field_id": field_id, "published": versions.times[index], **_stored_label(label)}
            for index, field_id in enumerate(versions.field_ids)
            for label in (versions.label(index + 1),)
        ],
    }


def _stored_label(label: VersionLabel) -> dict[str, Any]:
    """Return what differs from the tile's own light, so that plain manifests stay short."""
    plain = asdict(OWN_LIGHT)
    return {name: value for name, value in asdict(label).items() if value != plain[name]}
