"""``tiles.json`` in a folder of fields: the versions of each tile, and which one is current.

The folder holds archives by content (``<sha256>.rff``), so publishing never changes a file that a
vehicle may be fetching; what is current is one name in the manifest, which is replaced as a whole.
A folder without the file publishes no tiles.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.files import write_whole
from rfcore.wire.checks import check_field_id, check_name
from rfcore.wire.tiles import MAX_TILES, Area, Tile

__all__ = ["MANIFEST", "Publication", "TileVersions", "read_publication", "write_publication"]

MANIFEST = "tiles.json"
FORMAT = "rfedge tiles 1"


@dataclass(frozen=True)
class TileVersions:
    """All versions of one tile, the first is number 1; ``times`` (ISO 8601) when each came."""

    field_ids: tuple[str, ...]
    times: tuple[str, ...]
    current: int
    area: Area | None = None
    margin_m: float = 0.0

    def __post_init__(self) -> None:
        for field_id in self.field_ids:
            check_field_id("tile.versions", field_id)
        if len(self.times) != len(self.field_ids):
            raise InvalidInput("tile.versions", "not every version has its time")
        if not 1 <= self.current <= len(self.field_ids):
            raise InvalidInput(
                "tile.current", f"{self.current} is outside 1..{len(self.field_ids)}"
            )

    def tile(self, name: str) -> Tile:
        """Return the current version."""
        field_id = self.field_ids[self.current - 1]
        return Tile(name, field_id, self.current, self.area, self.margin_m)


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
        "versions": [
            {"field_id": field_id, "published": time}
            for field_id, time in zip(versions.field_ids, versions.times, strict=True)
        ],
    }
