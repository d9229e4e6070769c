"""Publish a field as the next version of a tile, take it back, say what there is.

The archive is checked and put into the folder first; only then does the manifest name it, in one
rename. Whoever publishes at the same time waits: the folder has a lock, which a crash releases.
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
from rfcore.wire.tile_manifest import Publication, TileVersions, read_publication, write_publication
from rfcore.wire.tiles import Area, Tile

__all__ = ["Ground", "publish", "roll_back"]

LOCK = ".tiles.lock"


@dataclass(frozen=True)
class Ground:
    """Where a tile's field serves; what is None stays as it was, at first: everywhere, 0 m."""

    area: Area | None = None
    margin_m: float | None = None


def publish(folder: Path, name: str, archive: Path, ground: Ground, now: datetime) -> Tile:
    """Make ``archive`` the current version of tile ``name`` of ``folder``; return it.

    The field that is current already stays the same version. Raises ``FieldFormatError`` for a
    damaged archive, ``InvalidInput``; the folder then publishes what it did.
    """
    store = FieldStore(folder)
    with _locked(folder):
        field_id = store.add(archive)
        publication = read_publication(folder)
        versions = _next(publication.tiles.get(name), field_id, now.astimezone(UTC))
        if ground.area is not None:
            versions = replace(versions, area=ground.area)
        if ground.margin_m is not None:
            versions = replace(versions, margin_m=ground.margin_m)
        return _write(folder, publication, name, versions)


def roll_back(folder: Path, name: str, to: int | None = None) -> Tile:
    """Make version ``to`` of a tile current again, the one before the current without it.

    Raises ``InvalidInput`` for a tile or version that is not there, ``UnknownField`` if the
    version's archive was removed.
    """
    with _locked(folder):
        publication = read_publication(folder)
        if name not in publication.tiles:
            here = ", ".join(sorted(publication.tiles)) or "none"
            raise InvalidInput("tile", f"{name!r} is not published in {folder} (tiles: {here})")
        versions = publication.tiles[name]
        wanted = versions.current - 1 if to is None else to
        if not 1 <= wanted <= len(versions.field_ids):
            raise InvalidInput(
                "to", f"version {wanted} of {name!r} is outside 1..{len(versions.field_ids)}"
            )
        field_id = versions.field_ids[wanted - 1]
        if field_id not in FieldStore(folder).ids():
            raise UnknownField(f"version {wanted} of {name!r}, field {field_id}, is gone")
        return _write(folder, publication, name, replace(versions, current=wanted))


def _next(versions: TileVersions | None, field_id: str, now: datetime) -> TileVersions:
    time = now.isoformat(timespec="seconds")
    if versions is None:
        return TileVersions((field_id,), (time,), 1)
    if versions.field_ids[versions.current - 1] == field_id:
        return versions
    field_ids = (*versions.field_ids, field_id)
    return replace(
        versions, field_ids=field_ids, times=(*versions.times, time), current=len(field_ids)
    )


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
