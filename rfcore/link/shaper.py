"""A link as a queue with three verbs (``push``, ``pop_due``, ``next_event_at``), and a busy meter.

This is the paper's NetworkTX (send, then wait tau = 8 * bytes / throughput), store and forward. A
packet that finds the link busy is transmitted from the moment the previous one is *due* to end,
never from the moment somebody looks: late drivers cause no drift. Within a busy period every end is
computed from the period's start and an integer number of bytes, so rounding errors do not
accumulate.

The transmission and the delays beyond the profile's constant one are exchangeable parts
(``rfcore.link.plan``); whatever they do, packets keep their order. Times are seconds on any clock
of the caller's that does not run backwards; parts see the seconds since the link's origin.

``BusyMeter`` checks a real-time driver of the link: from the moments at which packets were really
released it computes how long the link was busy (the union of the intervals from the start of a busy
period to the release of its last packet, without propagation). Compared with ``expected_s``, the
time that the link's own schedule gave those bytes, an excess shows late releases.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from rfcore.errors import InvalidInput

MAX_RATE_BPS = 1e12
"""Above a terabit per second the transmission time drowns in the clock's resolution."""
MAX_DELAY_S = 60.0
"""A delay longer than a minute is a unit mistake (milliseconds given as seconds)."""

Item = TypeVar("Item")
Delay = Callable[[float], float]
"""Returns the additional seconds of a packet whose transmission ended so long after the origin."""


@dataclass(frozen=True)
class LinkProfile:
    """A link of ``rate_bps`` bits per second and ``delay_s`` seconds of propagation.

    ``queue_limit_bytes`` is how much may wait for transmission, beside what is in propagation.
    Raises ``InvalidInput`` naming the value and its limit.
    """

    rate_bps: float
    delay_s: float = 0.0
    queue_limit_bytes: int = 64 * 1024

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate_bps) and 1.0 <= self.rate_bps <= MAX_RATE_BPS):
            raise InvalidInput(
                "link.rate_bps", f"{self.rate_bps} is outside 1..{MAX_RATE_BPS:g} bits per second"
            )
        if not (math.isfinite(self.delay_s) and 0.0 <= self.delay_s <= MAX_DELAY_S):
            raise InvalidInput("link.delay_s", f"{self.delay_s} is outside 0..{MAX_DELAY_S:g} s")
        if self.queue_limit_bytes < 1:
            raise InvalidInput(
                "link.queue_limit_bytes", f"{self.queue_limit_bytes} must be at least 1 byte"
            )


@dataclass(frozen=True)
class Delivery(Generic[Item]):
    """One packet that leaves the link: sent during ``start_s..end_s``, delivered at ``due_s``."""

    item: Item
    size_bytes: int
    start_s: float
    end_s: float
    due_s: float


class Transmission(Protocol):
    """Decides when bytes get through, first come first served; times are since the origin."""

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Take ``size_bytes`` that arrive at ``at_s``; return when they start and end."""


class ConstantRate:
    """Transmits ``rate_bps`` bits per second."""

    def __init__(self, rate_bps: float) -> None:
        self._rate_bps = rate_bps
        self._period_start_s = float("-inf")
        self._period_bytes = 0
        self._busy_until_s = float("-inf")

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Return start and end of transmission."""
        if at_s >= self._busy_until_s:
            self._period_start_s, self._period_bytes, self._busy_until_s = at_s, 0, at_s
        start_s = self._busy_until_s
        self._period_bytes += size_bytes
        self._busy_until_s = self._period_start_s + self._period_bytes * 8 / self._rate_bps
        return start_s, self._busy_until_s


@dataclass(frozen=True)
class LinkParts:
    """The transmitter of a link, and the sources of its delay."""

    transmission: Transmission
    delays: tuple[Delay, ...] = ()

    def with_delay(self, delay: Delay) -> LinkParts:
        """Return these parts and one more delay."""
        return replace(self, delays=(*self.delays, delay))


class Connection:
    """Stands for a connection through a link; one that is gone is forgotten."""


class Link(Generic[Item]):
    """A first-in first-out link that loses and reorders nothing.

    ``parts`` are a constant rate unless given. 1000 bytes take 1 s at 8 kbit/s, and 0.5 s more:

    >>> from rfcore.link.shaper import Link, LinkProfile
    >>> link = Link(LinkProfile(rate_bps=8000, delay_s=0.5))
    >>> link.push("a frame", 1000, now=10.0).due_s
    11.5
    >>> link.pop_due(now=11.4), [delivery.item for delivery in link.pop_due(now=11.5)]
    ([], ['a frame'])
    """

    def __init__(
        self, profile: LinkProfile, parts: LinkParts | None = None, origin_s: float = 0.0
    ) -> None:
        self.profile = profile
        self._parts = parts or LinkParts(ConstantRate(profile.rate_bps))
        self._origin_s = origin_s
        self._queue: deque[Delivery[Item]] = deque()
        self._sending: deque[Delivery[Item]] = deque()
        self._held_bytes = 0
        self._waiting_bytes = 0
        self._last_due_s = float("-inf")

    @property
    def held_bytes(self) -> int:
        """Bytes pushed and not yet popped: waiting, or in propagation."""
        return self._held_bytes

    def room_bytes(self, now: float) -> int:
        """Return how much may be pushed; what is in propagation takes no room."""
        self._forget_sent(now)
        return max(0, self.profile.queue_limit_bytes - self._waiting_bytes)

    def is_full(self, now: float) -> bool:
        """Return whether the caller should stop pushing until ``room_at``."""
        return self.room_bytes(now) == 0

    def room_at(self) -> float | None:
        """Return when the packet in front leaves the queue, or None when none waits."""
        return self._sending[0].end_s if self._sending else None

    def push(
        self,
        item: Item,
        size_bytes: int,
        now: float,
        connection: Connection | None = None,  # noqa: ARG002
    ) -> Delivery[Item]:
        """Accept ``item`` at ``now`` and return when it will be transmitted and delivered.

        Connections share the link first come first served, so which one it is does not matter.

        Raises ``InvalidInput`` for a negative size, and when the link is full: a link drops
        nothing, so its driver has to hold the sender back (see ``is_full``). An empty packet, which
        takes no room, is always accepted.
        """
        if size_bytes < 0:
            raise InvalidInput("link.size_bytes", f"{size_bytes} must not be negative")
        if size_bytes and self.is_full(now):
            raise InvalidInput(
                "link.queue",
                f"{self._waiting_bytes} bytes are waiting, the limit is "
                f"{self.profile.queue_limit_bytes}; push again at room_at()",
            )
        delivery = self._schedule(item, size_bytes, now)
        self._queue.append(delivery)
        self._held_bytes += size_bytes
        if size_bytes:
            self._sending.append(delivery)
            self._waiting_bytes += size_bytes
        return delivery

    def _schedule(self, item: Item, size_bytes: int, now: float) -> Delivery[Item]:
        start, end = self._parts.transmission.schedule(size_bytes, now - self._origin_s)
        more_s = sum(delay(end) for delay in self._parts.delays)
        start_s, end_s = self._origin_s + start, self._origin_s + end
        due_s = max(end_s + self.profile.delay_s + more_s, self._last_due_s)
        self._last_due_s = due_s
        return Delivery(item, size_bytes, start_s, end_s, due_s)

    def _forget_sent(self, now: float) -> None:
        while self._sending and self._sending[0].end_s <= now:
            self._waiting_bytes -= self._sending.popleft().size_bytes

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


class BusyMeter:
    """Measures how long one link was busy; it is told of every release, in order.

    ``expected_s`` is how long the machine said the link would be busy.
    """

    def __init__(self) -> None:
        self._period_start_s = 0.0
        self._scheduled_end_s = float("-inf")
        self._measured_end_s = float("-inf")
        self._closed_s = 0.0
        self.expected_s = 0.0
        self.wire_bytes = 0
        self.periods = 0
        self.largest_lateness_s = 0.0

    def released(self, delivery: Delivery[Any], at_s: float) -> None:
        """Take note that ``delivery`` left the link at ``at_s``."""
        if delivery.start_s > self._scheduled_end_s:
            self.periods += 1
            self._closed_s = self.busy_s
            self._period_start_s = max(delivery.start_s, self._measured_end_s)
        in_propagation_s = delivery.due_s - delivery.end_s
        self._scheduled_end_s = delivery.end_s
        self._measured_end_s = max(at_s - in_propagation_s, self._period_start_s)
        self.expected_s += delivery.end_s - delivery.start_s
        self.wire_bytes += delivery.size_bytes
        self.largest_lateness_s = max(self.largest_lateness_s, at_s - delivery.due_s)

    @property
    def busy_s(self) -> float:
        """Seconds the link was busy, measured."""
        if self._measured_end_s == float("-inf"):
            return 0.0
        return self._closed_s + self._measured_end_s - self._period_start_s

    @property
    def tau_error_percent(self) -> float | None:
        """Share of ``expected_s`` by which the link was busy longer; None before the first byte."""
        if not self.expected_s:
            return None
        return 100.0 * (self.busy_s / self.expected_s - 1.0)
