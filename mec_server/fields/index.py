"""The archives a server holds, as a snapshot that streams read and a background task renews.

Reading a folder and hashing archives takes as long as the disk likes, so it never happens on the
event loop: ``refresh`` runs on a thread, and ``ids`` and ``path`` only look at what it found. A new
file is listed by the second look that finds it unchanged.

Which tiles the folder publishes is kept up to date likewise: a manifest that cannot be read, or
that names a field which cannot be opened, changes nothing: the tiles that were current stay, and
the problem is logged once for each manifest.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import structlog

from rfcore.errors import RfedgeError, UnknownField, named
from rfcore.field import RadianceField
from rfcore.field.folder import FIELD_ID, SUFFIX, FieldFolder, FolderListing
from rfcore.field.own import OwnField
from rfcore.field.store import load_checked
from rfcore.wire.settings import RenderSettings
from rfcore.wire.tile_manifest import MANIFEST, Publication, read_publication
from rfcore.wire.tiles import Tile

log = structlog.get_logger()
Stamp = tuple[int, int, int] | None


class FieldIndex:
    """The fields of ``directory``, as of the last ``refresh``, and ``own``: fields of users'
    classes, by id, which have no file."""

    def __init__(self, directory: Path, own: Mapping[str, OwnField] | None = None) -> None:
        self.own = own or {}
        self._directory = directory
        self._folder = FieldFolder(directory)
        self._paths: Mapping[str, Path] = MappingProxyType({})
        self._skipped: Mapping[Path, str] = {}
        self._ids: tuple[str, ...] = tuple(sorted(self.own))
        self._opened: dict[str, Path] = {}
        self._lock = threading.Lock()

    def start(self) -> None:
        """Take everything that is there now."""
        self._take(self._folder.look())

    def refresh(self) -> None:
        """Look again; slow. An entry that is no archive is skipped, and logged once."""
        before = self._ids
        self._take(self._folder.look(settled=True))
        if self._ids != before:
            log.info("fields listed", fields=len(self._ids))

    def ids(self) -> tuple[str, ...]:
        """Return the ids of the fields that are here, sorted."""
        return self._ids

    def path(self, field_id: str) -> Path:
        """Return the file of a field; raise ``UnknownField``, which names the fields that are
        here."""
        path = self._paths.get(field_id)
        if field_id in self.own:
            name = self.own[field_id].name
            raise UnknownField(f"field {field_id!r} is code and has no file: run {name} yourself")
        if path is None:
            here = named(self._ids, "nothing")
            raise UnknownField(f"field {field_id!r} is not on this server; it holds {here}")
        return path

    def published_path(self, field_id: str) -> Path:
        """Return the file of a field that was published: it is complete before it is named, and
        may be newer than the last look."""
        path = self._directory / f"{field_id}{SUFFIX}"
        named = FIELD_ID.fullmatch(field_id) is not None and path.is_file()
        return path if named else self.path(field_id)

    def opened(self, field_id: str, path: Path) -> None:
        """List a field from now on: its content was checked, so it need not settle."""
        with self._lock:
            self._opened[field_id] = path
            self._list({**self._paths, field_id: path})

    def _take(self, listing: FolderListing) -> None:
        for path, problem in listing.skipped.items():
            if self._skipped.get(path) != problem:
                log.warning("entry skipped", path=str(path), problem=problem)
        self._skipped = listing.skipped
        with self._lock:
            new = self._opened.items() - listing.paths.items()
            self._opened = {field_id: path for field_id, path in new if path.is_file()}
            self._list({**self._opened, **listing.paths})

    def _list(self, paths: Mapping[str, Path]) -> None:
        self._paths = paths
        self._ids = tuple(sorted({*paths, *self.own}))


def field_loader(
    index: FieldIndex, render: RenderSettings, *, opened: Callable[[RadianceField], None]
) -> Callable[[str], RadianceField]:
    """Return a function that opens a field of ``index``: checked, and with its renderer built.

    ``opened`` is called with each field. The function raises ``UnknownField``,
    ``FieldFormatError`` or ``BackendUnavailable``.
    """

    def base(field_id: str) -> RadianceField:
        path = index.published_path(field_id)
        return load_checked(path, field_id, max_bytes=render.max_field_bytes)

    def load(field_id: str) -> RadianceField:
        if field_id in index.own:
            return index.own[field_id]
        path = index.published_path(field_id)
        field = load_checked(
            path,
            field_id,
            threads=render.threads,
            isa=render.field_isa,
            max_bytes=render.max_field_bytes,
            open_base=base,
        )
        index.opened(field_id, path)
        field.prepare()
        log.info(
            "field opened",
            field=field_id,
            kind=field.metadata.kind,
            primitives=field.primitives,
            isa=field.isa,
        )
        opened(field)
        return field

    return load


class PublishedFields:
    """The current tiles of ``folder``; ``open_field`` makes a field ready before it is current."""

    def __init__(self, folder: Path, open_field: Callable[[str], object]) -> None:
        self.tiles: tuple[Tile, ...] = ()
        self._folder = folder
        self._open_field = open_field
        self._seen: Stamp = None
        self._names: Mapping[str, str] = {}

    def start(self) -> None:
        """Read the publication; raise ``FieldFormatError`` or ``UnknownField``."""
        self._seen = self._stamp()
        self._take(read_publication(self._folder))

    def current(self) -> tuple[Tile, ...]:
        """Return the tiles that are published now."""
        return self.tiles

    def names_of(self, field_id: str) -> frozenset[str]:
        """Return the names of the published tiles that a field belongs to."""
        return frozenset(tile.name for tile in self.tiles if field_id in tile.archive_ids)

    def name_of(self, field_id: str) -> str:
        """Return the name of the tile that a field is or was published for; empty for no tile's."""
        return self._names.get(field_id, "")

    def look_again(self) -> None:
        """Have the next ``refresh`` follow the manifest though it was not replaced: a field that
        was missing is there now."""
        self._seen = None

    def refresh(self) -> bool:
        """Follow the manifest if it was replaced; return whether other tiles are current now."""
        stamp, before = self._stamp(), self.tiles
        if stamp == self._seen:
            return False
        self._seen = stamp
        try:
            self._take(read_publication(self._folder))
        except (RfedgeError, OSError) as error:
            log.error("publication not taken up", problem=str(error), kept=_named(before))
            return False
        log.info("publication taken up", tiles=_named(self.tiles))
        return self.tiles != before

    def _take(self, publication: Publication) -> None:
        tiles = publication.current()
        ready = {field_id for tile in self.tiles for field_id in tile.renderable_ids}
        for field_id in (field_id for tile in tiles for field_id in tile.renderable_ids):
            if field_id not in ready:
                self._open_field(field_id)
        self.tiles = tiles
        self._names = {
            field_id: name
            for name, versions in publication.tiles.items()
            for field_id in versions.field_ids
        }

    def _stamp(self) -> Stamp:
        try:
            stat = (self._folder / MANIFEST).stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_ino, stat.st_size


def _named(tiles: tuple[Tile, ...]) -> list[str]:
    return [
        " ".join([tile.name, str(tile.version), *(f"{x.name}:{x.version}" for x in tile.lights)])
        for tile in tiles
    ]
