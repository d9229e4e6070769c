"""What the page shows, and what each browser has not been sent yet. Without event loop or clock.

A message replaces the one before it under the same key: a camera's picture, the list of fields, the
state of the connection. A browser's ``Reader`` holds at most one message a key, so one that reads
slowly misses pictures, but never the newest, and delays nobody.
"""

from __future__ import annotations

import json
import struct
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["Board", "Message", "Reader"]


@dataclass(frozen=True)
class Message:
    """A JSON object for the page with the binary ``parts`` it names; made at ``made_s``.

    ``parts`` travel one after the other; the header's ``part_bytes`` says how long each is.
    """

    header: Mapping[str, Any]
    made_s: float
    parts: tuple[bytes, ...] = ()

    def encode(self, now_s: float) -> bytes:
        """Return it as one WebSocket message: length of the header (uint32, little-endian), header,
        parts. ``held_ms`` tells how long it waited here (``now_s``: the clock of ``made_s``)."""
        header = {
            **self.header,
            "held_ms": 1000.0 * max(0.0, now_s - self.made_s),
            "part_bytes": [len(part) for part in self.parts],
        }
        text = json.dumps(header, allow_nan=False).encode()
        return b"".join((struct.pack("<I", len(text)), text, *self.parts))


class Reader:
    """The messages that one browser has not been sent; ``arrived`` is called for each new one."""

    def __init__(self, arrived: Callable[[], None]) -> None:
        self.missed = 0
        self._arrived = arrived
        self._waiting: OrderedDict[Hashable, Message] = OrderedDict()

    def put(self, key: Hashable, message: Message) -> None:
        """Keep ``message`` for sending, in place of an older one of its key."""
        self.missed += key in self._waiting
        self._waiting[key] = message
        self._arrived()

    def take(self) -> Message | None:
        """Return what waits longest, or None."""
        return self._waiting.popitem(last=False)[1] if self._waiting else None


class Board:
    """The newest message of every key, and its readers."""

    def __init__(self) -> None:
        self._messages: dict[Hashable, Message] = {}
        self._readers: list[Reader] = []

    def post(self, key: Hashable, message: Message) -> None:
        """Show ``message`` to all readers, and to those that come later."""
        self._messages[key] = message
        for reader in self._readers:
            reader.put(key, message)

    def clear(self, key: Hashable, farewell: Message) -> None:
        """Forget ``key``; those who read now get ``farewell`` in its place."""
        if self._messages.pop(key, None) is not None:
            for reader in self._readers:
                reader.put(key, farewell)

    def read(self, arrived: Callable[[], None]) -> Reader:
        """Return a new reader, with everything that is shown now."""
        reader = Reader(arrived)
        for key, message in self._messages.items():
            reader.put(key, message)
        self._readers.append(reader)
        return reader

    def leave(self, reader: Reader) -> None:
        """Forget a reader."""
        self._readers.remove(reader)
