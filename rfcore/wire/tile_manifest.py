"""``tiles.json`` in a folder of fields: the versions of each tile, and which one is current.

The folder holds archives by content (``<sha256>.rff``), so publishing never changes a file that a
vehicle may be fetching; what is current is one name in the manifest, which is replaced as a whole.
A folder without the file publishes no tiles.

``publish`` makes a field the next version of a tile, ``roll_back`` takes it back. The archive is
checked and put into the folder first; only then does the manifest name it, in one rename.
Publishers wait for each other: the folder has a lock, which a crash releases.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rfcore.errors import FieldFormatError, InvalidData, InvalidInput, UnknownField
from rfcore.field import FieldStore
from rfcore.field.archive import decode_archive, read_file
from rfcore.field.interface import base_of
from rfcore.files import read_regular, write_whole
from rfcore.wire.tiles import MAX_TILES, Area, Tile, TileLight
from rfcore.wire.values import check_field_id, check_name

MANIFEST = "tiles.json"
FORMAT = "rfedge tiles 1"
MAX_MANIFEST_BYTES = 16 << 20


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
class TileVersion:
    """One version of a tile: its field, when it was published (ISO 8601), and its light."""

    field_id: str
    published: str
    label: VersionLabel = OWN_LIGHT

    def __post_init__(self) -> None:
        check_field_id("tile.versions", self.field_id)


@dataclass(frozen=True)
class TileVersions:
    """All versions of one tile, in order; the first has number 1.

    ``current`` is the number of the tile's own field, ``lights`` that of each other light.
    """

    versions: tuple[TileVersion, ...]
    current: int
    area: Area | None = None
    margin_m: float = 0.0
    lights: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.versions)
        for name, number in {"": self.current, **self.lights}.items():
            is_there = 1 <= number <= count
            if is_there and self.version(number).label.light != name:
                raise InvalidInput("tile.lights", f"version {number} is not of light {name!r}")
            if not is_there and name:
                raise InvalidInput("tile.lights", f"{name!r} is version {number}, of {count}")
            if not is_there:
                raise InvalidInput("tile.current", f"{number} is outside 1..{count}")

    @property
    def field_ids(self) -> tuple[str, ...]:
        """The fields of all versions."""
        return tuple(version.field_id for version in self.versions)

    def version(self, number: int) -> TileVersion:
        """Return the version of that number."""
        return self.versions[number - 1]

    def of_light(self, light: str) -> list[int]:
        """Return the numbers of the versions of a light, ascending; of the tile's own for ''."""
        numbered = enumerate(self.versions, 1)
        return [number for number, version in numbered if version.label.light == light]

    def followed_by(self, version: TileVersion) -> TileVersions:
        """Return these and one more version, which is the current one of its light."""
        versions = (*self.versions, version)
        return replace(self, versions=versions).having(version.label.light, len(versions))

    def having(self, light: str, number: int | None) -> TileVersions:
        """Return these with another current version of a light; None withdraws the light."""
        if not light:
            return self if number is None else replace(self, current=number)
        others = {name: n for name, n in self.lights.items() if name != light}
        return replace(self, lights=others if number is None else {**others, light: number})

    def tile(self, name: str) -> Tile:
        """Return the tile with what is current."""
        own = self.version(self.current)
        lights = tuple(self._light(light, n) for light, n in sorted(self.lights.items()))
        return Tile(name, own.field_id, self.current, self.area, self.margin_m, lights)

    def _light(self, name: str, number: int) -> TileLight:
        version = self.version(number)
        label = version.label
        return TileLight(
            name,
            version.field_id,
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
        content = json.loads(read_regular(path, MAX_MANIFEST_BYTES))
        if content["format"] != FORMAT:
            raise FieldFormatError(f"{path}: format {content['format']!r} is not {FORMAT!r}")
        return Publication({name: _versions(tile) for name, tile in content["tiles"].items()})
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, InvalidData) as error:
        raise FieldFormatError(f"{path}: {type(error).__name__} {error}") from error


def write_publication(folder: Path, publication: Publication) -> None:
    """Replace the manifest of ``folder`` as a whole. Raises ``OSError``."""
    tiles = {name: _stored(versions) for name, versions in sorted(publication.tiles.items())}
    write_whole(folder / MANIFEST, json.dumps({"format": FORMAT, "tiles": tiles}, indent=1) + "\n")


def _versions(stored: Mapping[str, Any]) -> TileVersions:
    area = stored["area"]
    return TileVersions(
        versions=tuple(_version(version) for version in stored["versions"]),
        current=int(stored["current"]),
        area=None if area is None else Area(_corner(area["low_m"]), _corner(area["high_m"])),
        margin_m=float(stored["margin_m"]),
        lights={str(name): int(number) for name, number in stored.get("lights", {}).items()},
    )


def _version(stored: Mapping[str, Any]) -> TileVersion:
    hour = stored.get("time_of_day_h")
    label = VersionLabel(
        str(stored.get("light", "")),
        str(stored.get("base_field_id", "")),
        int(stored.get("passes", 0)),
        None if hour is None else float(hour),
    )
    return TileVersion(str(stored["field_id"]), str(stored["published"]), label)


def _corner(stored: Any) -> tuple[float, float]:
    east_m, north_m = (float(value) for value in stored)
    return east_m, north_m


def _stored(versions: TileVersions) -> dict[str, Any]:
    return {
        "area": None if versions.area is None else asdict(versions.area),
        "margin_m": versions.margin_m,
        "current": versions.current,
        "lights": dict(sorted(versions.lights.items())),
        "versions": [_stored_version(version) for version in versions.versions],
    }


def _stored_version(version: TileVersion) -> dict[str, Any]:
    """Return a version with what differs from the tile's own light, so that plain files stay so."""
    own, label = asdict(OWN_LIGHT), asdict(version.label)
    more = {name: value for name, value in label.items() if value != own[name]}
    return {"field_id": version.field_id, "published": version.published, **more}


LOCK = ".tiles.lock"


@dataclass(frozen=True)
class Ground:
    """Ground that a tile's field serves.

    What is None stays as it was, at first: everywhere, and 0 m beyond it.
    """

    area: Area | None = None
    margin_m: float | None = None


def publish(
    folder: Path,
    name: str,
    archive: Path,
    ground: Ground,
    now: datetime,
    label: VersionLabel = OWN_LIGHT,
    *,
    only_after: Tile | None = None,
) -> Tile:
    """Make ``archive`` the current version of tile ``name`` of ``folder``; return the tile.

    ``label`` says which light it is of; the base of a layer is read from the archive. A field that
    is current already stays the same version. Raises ``FieldFormatError`` for a damaged archive,
    ``UnknownField`` for a layer whose base is not in the folder, and ``InvalidInput`` for a light
    of a tile without a field of its own, or where ``only_after`` is given and is not the current
    tile, since somebody else has published meanwhile. The folder is then left as it was.
    """
    store = FieldStore(folder)
    with _locked(folder):
        publication = read_publication(folder)
        before = publication.tiles.get(name)
        if before is None and label.light:
            raise InvalidInput("light", f"publish a field of tile {name!r} itself first")
        if only_after is not None and (before is None or before.tile(name) != only_after):
            raise InvalidInput("tile", f"{name!r} was published by somebody else meanwhile")
        field_id = store.add(archive)
        base = base_of(decode_archive(read_file(archive), str(archive))) or ""
        label = replace(label, base_field_id=base)
        versions = _next(before, field_id, now.astimezone(UTC), label)
        if ground.area is not None:
            versions = replace(versions, area=ground.area)
        if ground.margin_m is not None:
            versions = replace(versions, margin_m=ground.margin_m)
        return _write(folder, publication, name, versions)


def roll_back(folder: Path, name: str, to: int | None = None, light: str = "") -> Tile:
    """Make version ``to`` of a tile, or of one of its lights, current again; return the tile.

    Without ``to``, the version of that light before the current one; a light without any is
    withdrawn. Raises ``InvalidInput`` for a tile or version that is not there, ``UnknownField`` if
    the version's archive was removed.
    """
    with _locked(folder):
        publication = read_publication(folder)
        if name not in publication.tiles:
            here = ", ".join(sorted(publication.tiles)) or "none"
            raise InvalidInput("tile", f"{name!r} is not published in {folder} (tiles: {here})")
        versions = publication.tiles[name]
        wanted = _wanted(versions, name, to, light)
        if wanted is not None:
            field_id = versions.version(wanted).field_id
            if field_id not in FieldStore(folder).ids():
                raise UnknownField(f"version {wanted} of {name!r}, field {field_id}, is gone")
        return _write(folder, publication, name, versions.having(light, wanted))


def _wanted(versions: TileVersions, name: str, to: int | None, light: str) -> int | None:
    """Return the version to go back to; None where a light has no earlier one."""
    known = versions.of_light(light)
    if to is not None:
        if to not in known:
            of = f" of light {light!r}" if light else ""
            raise InvalidInput("to", f"version {to} of {name!r}{of} is none of {known}")
        return to
    now = versions.lights.get(light) if light else versions.current
    if now is None:
        raise InvalidInput("light", f"{light!r} is no current light of {name!r}")
    earlier = [number for number in known if number < now]
    if not earlier and not light:
        raise InvalidInput("to", f"version {now} of {name!r} is the first; there is none before it")
    return earlier[-1] if earlier else None


def _next(
    versions: TileVersions | None, field_id: str, now: datetime, label: VersionLabel
) -> TileVersions:
    version = TileVersion(field_id, now.isoformat(timespec="seconds"), label)
    if versions is None:
        return TileVersions((version,), 1)
    current = versions.lights.get(label.light, 0) if label.light else versions.current
    if current and versions.version(current).field_id == field_id:
        return versions
    return versions.followed_by(version)


def _write(folder: Path, publication: Publication, name: str, versions: TileVersions) -> Tile:
    write_publication(folder, publication.having(name, versions))
    return versions.tile(name)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other publishers out."""
    if not folder.is_dir():
        raise InvalidInput("folder", f"{folder} is not a directory")
    with (folder / LOCK).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
