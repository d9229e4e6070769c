"""Publish a field as the next version of a tile, or take it back.

The archive is checked and put into the folder first; only then does the manifest name it, in one
rename. Publishers wait for each other: the folder has a lock, which a crash releases.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rfcore.errors import InvalidInput, UnknownField
from rfcore.field import FieldStore
from rfcore.field.archive import decode_archive, read_file
from rfcore.field.interface import base_of
from rfcore.wire.tile_manifest import (
    OWN_LIGHT,
    Publication,
    TileVersion,
    TileVersions,
    VersionLabel,
    read_publication,
    write_publication,
)
from rfcore.wire.tiles import Area, Tile

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
