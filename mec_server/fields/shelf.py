"""The fields this server holds: kept ready to render, listed and handed out.

A field file is opened when the first vehicle asks for it and stays in memory, up to a limit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from os import SEEK_END
from pathlib import Path
from typing import Protocol

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField

__all__ = ["CHUNK_BYTES", "FieldShelf", "Store", "read_chunk"]

CHUNK_BYTES = 64 * 1024
"""As much as a connection's window: what a peer that does not read costs in memory."""

MAX_OPEN_FIELDS = 8


class Store(Protocol):
    """Field archives, as ``mec_server.fields.index.FieldIndex``."""

    def ids(self) -> Sequence[str]:
        """Return the ids of the fields there."""

    def path(self, field_id: str) -> Path:
        """Return an archive's path; raise ``UnknownField``."""


class FieldShelf:
    """A cache of ``most`` opened fields of ``store``: ``load`` opens one, the least recently used
    leaves."""

    def __init__(
        self, store: Store, load: Callable[[str], RadianceField], most: int = MAX_OPEN_FIELDS
    ) -> None:
        self._store = store
        self._most = most
        self._load = load
        self._open: OrderedDict[str, RadianceField] = OrderedDict()
        self._lock = threading.Lock()

    def open(self, field_id: str) -> RadianceField:
        """Return a field, ready to render; raise ``UnknownField`` or ``FieldFormatError``."""
        with self._lock:
            if field_id not in self._open:
                self._open[field_id] = self._load(field_id)
                if len(self._open) > self._most:
                    self._open.popitem(last=False)
            self._open.move_to_end(field_id)
            return self._open[field_id]

    def opened(self, field_id: str) -> RadianceField | None:
        """Return a field if it is open, ``None`` otherwise; waits for one that is being opened."""
        with self._lock:
            return self._open.get(field_id)

    def warm_up(self) -> int:
        """Open fields in advance, so that the first vehicle waits for none; return how many.

        Fields that are open already (the published ones) are taken to be all that is needed.
        """
        ids = list(self._open or self._store.ids())[:MAX_OPEN_FIELDS]
        for field_id in ids:
            self.open(field_id)
        return len(ids)


def read_chunk(path: Path, offset_bytes: int) -> bytes:
    """Return up to ``CHUNK_BYTES`` of a file from ``offset_bytes`` on; nothing at its end.

    Each chunk opens the file and closes it: a transfer that is cut, or that nobody reads, holds
    none open. Raises ``InvalidInput`` for an offset past the end, and ``OSError``.
    """
    with path.open("rb", buffering=0) as file:
        size_bytes = file.seek(0, SEEK_END)
        if offset_bytes > size_bytes:
            raise InvalidInput(
                "offset_bytes", f"{offset_bytes} is past the end of a field of {size_bytes} bytes"
            )
        file.seek(offset_bytes)
        return file.read(CHUNK_BYTES)
