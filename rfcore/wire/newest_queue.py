"""A queue that keeps only the newest entry of each key, for readers that may be slow."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class NewestQueue(Generic[K, V]):
    """Entries that wait for one reader: at most one of each key, the longest waiting first.

    A reader that takes entries slowly misses older ones of a key, but never the newest, and takes
    bounded memory. ``missed`` counts the entries that were replaced; ``arrived`` is called for
    each entry. Not thread-safe.
    """

    def __init__(self, arrived: Callable[[], None]) -> None:
        self.missed = 0
        self._arrived = arrived
        self._waiting: OrderedDict[K, V] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, key: K, entry: V) -> bool:
        """Add ``entry``; return whether it replaced one of its key, whose turn it then has."""
        replaced = key in self._waiting
        self.missed += replaced
        self._waiting[key] = entry
        self._arrived()
        return replaced

    def discard(self, key: K) -> None:
        """Remove the entry of ``key``, if one waits; it does not count as missed."""
        self._waiting.pop(key, None)

    def take(self) -> V | None:
        """Remove and return the entry that waits longest; None if there is none."""
        return self._waiting.popitem(last=False)[1] if self._waiting else None
