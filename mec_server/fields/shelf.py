"""The fields this server holds: kept ready to render, listed and handed out.

A field file is opened when the first vehicle asks for it and stays in memory, up to a limit.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from os import SEEK_END
from pathlib import Path
from typing import Protocol

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import Bounds, RadianceField, render_field_view
from rfcore.field.interface import SPLATS

CHUNK_BYTES = 64 * 1024
"""Size of a chunk, the same as a connection's window: the memory that a peer which does not read
costs."""

MAX_OPEN_FIELDS = 8

TYPICAL_CAMERA = Intrinsics(640, 360, 400.0, 400.0, 320.0, 180.0)
"""The camera of the picture that is drawn in advance."""


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

    def draw_once(self) -> None:
        """Warm up: draw one picture of the largest open field of splats.

        The first picture of each thread, and the first pictures drawn at the same time, set up
        memory that later ones reuse: for the street that ships, 10 MB and 40 ms of a processor
        whose host reclaims free memory, beside the 40 ms that the picture takes. A hash grid needs
        next to nothing.
        """
        with self._lock:
            fields = [field for field in self._open.values() if field.metadata.kind == SPLATS]
        if fields:
            field = max(fields, key=lambda field: field.primitives)
            with suppress(InvalidInput):  # too much to be drawn there: what a vehicle would be told
                render_field_view(field, _from_the_middle(field.bounds))

    def warm_up(self) -> int:
        """Open fields in advance, so that the first vehicle waits for none; return how many.

        Fields that are open already (the published ones) are taken to be all that is needed.
        """
        ids = list(self._open or self._store.ids())[:MAX_OPEN_FIELDS]
        for field_id in ids:
            self.open(field_id)
        return len(ids)


def _from_the_middle(bounds: Bounds) -> Camera:
    """Return a camera in the middle of a field that looks along its longer side."""
    east_m, north_m, up_m = (np.add(bounds.low_m, bounds.high_m) / 2).tolist()
    long_m, wide_m, _ = np.subtract(bounds.high_m, bounds.low_m).tolist()
    along, aside = ((1.0, 0.0), (0.0, -1.0)) if long_m > wide_m else ((0.0, 1.0), (1.0, 0.0))
    pose = Pose.from_matrix(
        [
            [aside[0], 0.0, along[0], east_m],
            [aside[1], 0.0, along[1], north_m],
            [0.0, -1.0, 0.0, up_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return Camera(TYPICAL_CAMERA, pose)


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
