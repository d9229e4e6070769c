"""Which tiles a folder publishes, kept up to date while the server runs.

A manifest that cannot be read, or that names a field which cannot be opened, changes nothing: the
tiles that were current stay, and the problem is logged once for each manifest.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import structlog

from rfcore.errors import RfedgeError
from rfcore.wire.tile_manifest import MANIFEST, read_publication
from rfcore.wire.tiles import Tile

__all__ = ["PublishedFields"]

log = structlog.get_logger()
Stamp = tuple[int, int, int] | None


class PublishedFields:
    """The current tiles of ``folder``; ``open_field`` makes a field ready before it is current."""

    def __init__(self, folder: Path, open_field: Callable[[str], object]) -> None:
        self.tiles: tuple[Tile, ...] = ()
        self._folder = folder
        self._open_field = open_field
        self._seen: Stamp = None

    def start(self) -> None:
        """Take what is published; raise ``FieldFormatError`` or ``UnknownField``."""
        self._seen = self._stamp()
        self._take(read_publication(self._folder).current())

    def refresh(self) -> bool:
        """Follow the manifest if it was replaced; return whether other tiles are current now."""
        stamp, before = self._stamp(), self.tiles
        if stamp == self._seen:
            return False
        self._seen = stamp
        try:
            self._take(read_publication(self._folder).current())
        except (RfedgeError, OSError) as error:
            log.error("publication not taken up", problem=str(error), kept=_named(before))
            return False
        log.info("publication taken up", tiles=_named(self.tiles))
        return self.tiles != before

    def _take(self, tiles: tuple[Tile, ...]) -> None:
        ready = {field_id for tile in self.tiles for field_id in tile.renderable_ids}
        for field_id in (field_id for tile in tiles for field_id in tile.renderable_ids):
            if field_id not in ready:
                self._open_field(field_id)
        self.tiles = tiles

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
