"""``rfedge field publish``, ``list`` and ``rollback``: versions of the tiles a server offers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from rfcore.program import working
from rfedge.arguments import FIELD, FOLDER, field_path

if TYPE_CHECKING:
    from rfcore.wire.tile_manifest import Publication, VersionLabel
    from rfcore.wire.tiles import Tile
    from rfedge.datasets.convert import SplitTile

DAMAGED, GONE = "damaged", "gone"


@dataclass(frozen=True)
class FieldPublish:
    """Publish a field as the next version of a tile; running servers take it up."""

    field: Annotated[Path, Positional, FIELD]
    """The archive (.rff), or the field's name; or a folder of tiles that `rfedge train` trained:
    each is published under its own name, for its own ground."""
    folder: Annotated[Path, FOLDER]
    """The server's folder of fields (mec-server --fields)."""
    tile: Annotated[str, arg(metavar="NAME")] = "street"
    """The tile whose field it is."""
    area: Annotated[
        tuple[float, float, float, float] | None, arg(metavar="WEST SOUTH EAST NORTH")
    ] = None
    """West, south, east and north side of the ground it is for, m; default: as before, at first
    everywhere."""
    margin_m: float | None = None
    """Distance beyond its ground to which the field serves where no neighbour does; at first 0."""
    light: str = ""
    """Publish it beside the tile's own field, as the tile under another light of this name; a
    vehicle takes what is nearest to its frames. Publish a colour layer (field update) like this."""
    time_of_day_h: float | None = None
    """Hour of the day, UTC, of that light."""
    passes: int = 0
    """Number of passes it was learnt from."""

    def run(self) -> None:
        """Publish, and say what is current."""
        from datetime import UTC, datetime

        from rfcore.wire.tile_manifest import Ground, VersionLabel, publish
        from rfcore.wire.tiles import Area
        from rfedge.datasets.convert import read_tiles

        tiles = read_tiles(self.field)
        if tiles is not None:
            self._publish_tiles(tiles)
            return
        area = None
        if self.area is not None:
            west_m, south_m, east_m, north_m = self.area
            area = Area((west_m, south_m), (east_m, north_m))
        ground = Ground(area, self.margin_m)
        label = VersionLabel(self.light, "", self.passes, self.time_of_day_h)
        now, path = datetime.now(UTC), field_path(self.field)
        with working(f"checking and copying {path}"):
            published = publish(self.folder, self.tile, path, ground, now, label)
        print(_current(published, self.light))

    def _publish_tiles(self, tiles: tuple[SplitTile, ...]) -> None:
        """Publish every tile of a split, or none where a field is missing."""
        from datetime import UTC, datetime

        from rfcore.errors import InvalidInput
        from rfcore.wire.tile_manifest import Ground, publish
        from rfcore.wire.tiles import Area

        default = {each.name: each.default for each in fields(self)}
        for name in ("tile", "area", "margin_m", "light", "time_of_day_h", "passes"):
            if getattr(self, name) != default[name]:
                raise InvalidInput(name, "goes with one field: tiles.json says it of each tile")
        archives = [self.field / f"{tile.name}.rff" for tile in tiles]
        missing = [str(archive) for archive in archives if not archive.is_file()]
        if missing:
            raise InvalidInput("field", f"{', '.join(missing)} is missing: train all tiles first")
        for tile, archive in zip(tiles, archives, strict=True):
            ground = Ground(Area(tile.area_m[:2], tile.area_m[2:]), tile.margin_m)
            print(_current(publish(self.folder, tile.name, archive, ground, datetime.now(UTC)), ""))


@dataclass(frozen=True)
class FieldList:
    """List the tiles that a folder publishes, with all their versions."""

    folder: Annotated[Path, Positional, FOLDER]
    """The server's folder of fields (mec-server --fields)."""
    verify: bool = False
    """Read every archive and compare its SHA-256 with its id, as for a backup. A damaged archive is
    an error, and so is a missing one that is current; earlier versions may be missing."""

    def run(self) -> None:
        """Print a line a version; the current one has a star. Verified: ``InvalidData`` if bad."""
        from rfcore.errors import InvalidData
        from rfcore.wire.tile_manifest import read_publication

        publication = read_publication(self.folder)
        if self.verify and not publication.tiles:
            raise InvalidData(f"{self.folder} publishes no tiles: nothing to verify")
        states = _states(self.folder, publication) if self.verify else {}
        self._print(publication, states)
        needed = {i for tile in publication.current() for i in tile.archive_ids}
        bad = [i for i, state in states.items() if state == DAMAGED or (state and i in needed)]
        if bad:
            text = ", ".join(f"{field_id} is {states[field_id]}" for field_id in bad)
            raise InvalidData(
                f"{self.folder}: {text}; copy {bad[0]}.rff from another server or a backup"
            )
        if self.verify:
            whole = sum(not state for state in states.values())
            print(f"{whole} of {len(states)} archives are whole")

    def _print(self, publication: Publication, states: Mapping[str, str]) -> None:
        if not publication.tiles:
            print(f"{self.folder} publishes no tiles")
        for name, tile in sorted(publication.tiles.items()):
            ground = "everywhere"
            if tile.area is not None:
                low, high = tile.area.low_m, tile.area.high_m
                ground = f"{low[0]:g}, {low[1]:g} to {high[0]:g}, {high[1]:g} m"
            print(f"{name}: {ground}, margin {tile.margin_m:g} m")
            for number, version in enumerate(tile.versions, 1):
                is_current = number == tile.current or number in tile.lights.values()
                mark, light = "*" if is_current else " ", _light_text(version.label)
                field_id, state = version.field_id, states.get(version.field_id)
                state = f"  {state}" if state else ""
                print(f"{mark} {number:3}  {version.published}  {field_id}{light}{state}")


@dataclass(frozen=True)
class FieldRollback:
    """Make an earlier version of a tile current again; running servers take it up."""

    folder: Annotated[Path, FOLDER]
    """The server's folder of fields (mec-server --fields)."""
    tile: Annotated[str, arg(metavar="NAME")] = "street"
    """The tile to take back."""
    to: int | None = None
    """The version to make current; default: the one before the current."""
    light: str = ""
    """Take back a light of the tile; one without an earlier version is withdrawn."""

    def run(self) -> None:
        """Roll back, and say what is current."""
        from rfcore.wire.tile_manifest import roll_back

        print(_current(roll_back(self.folder, self.tile, self.to, self.light), self.light))


def _current(tile: Tile, light: str) -> str:
    """Return a line that says what is current, for a light or for the tile itself."""
    if not light:
        return f"{tile.name} is version {tile.version}, field {tile.field_id}"
    for one in tile.lights:
        if one.name == light:
            return f"{tile.name}, {light}: version {one.version}, field {one.field_id}"
    return f"{tile.name}, {light}: withdrawn"


def _states(folder: Path, publication: Publication) -> dict[str, str]:
    """Return the defect of each archive that is named, empty for none."""
    from hashlib import sha256

    from rfcore.field.archive import read_file

    states: dict[str, str] = {}
    for tile in publication.tiles.values():
        bases = [version.label.base_field_id for version in tile.versions]
        for field_id in dict.fromkeys(filter(None, (*tile.field_ids, *bases))):
            path = folder / f"{field_id}.rff"
            if not path.exists():
                states[field_id] = GONE
            else:
                whole = sha256(read_file(path)).hexdigest() == field_id
                states[field_id] = "" if whole else DAMAGED
    return states


def _light_text(label: VersionLabel) -> str:
    if not label.light:
        return ""
    hour = "" if label.time_of_day_h is None else f" at {label.time_of_day_h:.1f} h"
    layer = f", a layer on {label.base_field_id[:16]}" if label.base_field_id else ""
    return f"  {label.light}{hour}, {label.passes} passes{layer}"
