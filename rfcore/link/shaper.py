"""The link as a queue with three verbs: ``push``, ``pop_due``, ``next_event_at``.

NetworkTX of the paper (send, wait tau = 8 * bytes / throughput), store and forward. A packet that
finds the link busy is transmitted from the moment the previous one is *due* to end, never from the
moment somebody looks: late drivers cause no drift. Within a busy period every end is computed from
the period's start and an integer number of bits, so nothing accumulates but one rounding.

Times are seconds on any clock of the caller's that does not run backwards.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

from rfcore.errors import InvalidInput
from rfcore.link.profile import LinkProfile

__all__ = ["Delivery", "Link"]

Item = TypeVar("Item")


@dataclass(frozen=True)
class Delivery(Generic[Item]):
    """One packet leaving the link: transmitted during ``start_s..end_s``, delivered ``due_s``."""

    item: Item
    size_bytes: int
    start_s: float
    end_s: float
    due_s: float


class Link(Generic[Item]):
    """A first-in first-out link of constant rate and delay; loses and reorders nothing."""

    def __init__(self, profile: LinkProfile) -> None:
        self.profile = profile
        self._queue: deque[Delivery[Item]] = deque()
        self._held_bytes = 0
        self._period_start_s = float("-inf")
        self._period_bytes = 0
        self._busy_until_s = float("-inf")

    @property
    def held_bytes(self) -> int:
        """Bytes pushed and not yet popped."""
        return self._held_bytes

    @property
    def is_full(self) -> bool:
        """Whether the caller should stop pushing until something was popped."""
        return self._held_bytes >= self.profile.held_limit_bytes

    def push(self, item: Item, size_bytes: int, now: float) -> Delivery[Item]:
        """Accept ``item`` at ``now`` and return when it will be transmitted and delivered.

        Raises ``InvalidInput`` for a negative size, and when the link is full: a plain link drops
        nothing, so its driver has to hold the sender back (see ``is_full``). An empty packet, which
        takes no room, is always accepted.
        """
        if size_bytes < 0:
            raise InvalidInput("link.size_bytes", f"{size_bytes} must not be negative")
        if size_bytes and self.is_full:
            raise InvalidInput(
                "link.queue",
                f"{self._held_bytes} bytes are held, the limit is "
                f"{self.profile.held_limit_bytes}; pop before pushing more",
            )
        delivery = self._schedule(item, size_bytes, now)
        self._queue.append(delivery)
        self._held_bytes += size_bytes
        return delivery

    def _schedule(self, item: Item, size_bytes: int, now: float) -> Delivery[Item]:
        if now >= self._busy_until_s:
            self._period_start_s, self._period_bytes, self._busy_until_s = now, 0, now
        start_s = self._busy_until_s
        self._period_bytes += size_bytes
        end_s = self._period_start_s + self.profile.transmission_s(self._period_bytes)
        self._busy_until_s = end_s
        return Delivery(item, size_bytes, start_s, end_s, end_s + self.profile.delay_s)

    def pop_due(self, now: float) -> list[Delivery[Item]]:
        """Return, in order, every packet whose delivery is due at or before ``now``."""
        due: list[Delivery[Item]] = []
        while self._queue and self._queue[0].due_s <= now:
            due.append(self._queue.popleft())
            self._held_bytes -= due[-1].size_bytes
        return due

    def next_event_at(self) -> float | None:
        """Return when the next packet is due, or None when the link is empty."""
        return self._queue[0].due_s if self._queue else None
