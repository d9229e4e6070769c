"""The fields this server holds: kept ready to render, listed and handed out.

A field file is opened when the first vehicle asks for it and stays in memory, up to a limit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import structlog

from rfcore.errors import InvalidInput
from rfcore.field import FieldStore, RadianceField, Renderer
from rfcore.wire.settings import RenderSettings

__all__ = ["CHUNK_BYTES", "FieldShelf", "Store", "field_loader", "read_chunks"]

log = structlog.get_logger()

CHUNK_BYTES = 256 * 1024
"""A quarter of the receive limit."""

MAX_OPEN_FIELDS = 4


class Store(Protocol):
    """A directory of field archives, as ``rfcore.field.FieldStore``."""

    def ids(self) -> Sequence[str]:
        """Return the ids of the fields there."""

    def path(self, field_id: str) -> Path:
        """Return an archive's path; raise ``UnknownField``."""


class FieldShelf:
    """A cache of opened fields of ``store``: ``load`` opens one, the least recently used leaves."""

    def __init__(self, store: Store, load: Callable[[str], Renderer]) -> None:
        self._store = store
        self._load = load
        self._open: OrderedDict[str, Renderer] = OrderedDict()
        self._lock = threading.Lock()

    def open(self, field_id: str) -> Renderer:
        """Return a field, ready to render; raise ``UnknownField`` or ``FieldFormatError``."""
        with self._lock:
            if field_id not in self._open:
                self._open[field_id] = self._load(field_id)
                if len(self._open) > MAX_OPEN_FIELDS:
                    self._open.popitem(last=False)
            self._open.move_to_end(field_id)
            return self._open[field_id]

    def warm_up(self) -> int:
        """Open fields in advance, so that the first vehicle waits for none; return how many.

        Fields that are open already (the published ones) are taken to be all that is needed.
        """
        ids = list(self._open or self._store.ids())[:MAX_OPEN_FIELDS]
        for field_id in ids:
            self.open(field_id)
        return len(ids)


def field_loader(
    store: FieldStore, render: RenderSettings, *, opened: Callable[[RadianceField], None]
) -> Callable[[str], RadianceField]:
    """Return a function that opens a field of ``store``: checked, and with its renderer built.

    ``opened`` is called with each field. The function raises ``UnknownField``,
    ``FieldFormatError`` or ``BackendUnavailable``.
    """

    def load(field_id: str) -> RadianceField:
        field = store.load(field_id, threads=render.threads, isa=render.isa)
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


def read_chunks(path: Path, offset_bytes: int) -> Iterator[tuple[int, bytes]]:
    """Yield (offset, bytes) of a file from ``offset_bytes`` on.

    Raises ``InvalidInput`` for an offset past the end.
    """
    size_bytes = path.stat().st_size
    if offset_bytes > size_bytes:
        raise InvalidInput(
            "offset_bytes", f"{offset_bytes} is past the end of a field of {size_bytes} bytes"
        )
    with path.open("rb") as file:
        file.seek(offset_bytes)
        while chunk := file.read(CHUNK_BYTES):
            yield offset_bytes, chunk
            offset_bytes += len(chunk)
