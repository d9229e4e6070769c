"""Estimates how long a network path takes for a packet, from when others were sent and answered.

A packet of B bytes is answered ``min_rtt + B * cost`` after the packets before it were delivered:
``min_rtt`` is propagation, the answer's way back and the receiver's own time, ``cost`` the time of
a byte on the bottleneck. Delivery samples (size, round-trip time) do not tell the two apart:
packets of much the same size fit any ``min_rtt`` from 0 to the shortest round trip. So both ends of
that range are considered, and the smaller room counts:

* ``min_rtt`` 0: a sample of B bytes in T means that B * X / T bytes take no longer than X, for any
  X >= T. So quality climbs by what was delivered, a frame at a time.
* ``min_rtt`` = the shortest round trip of the last seconds: time beyond it is cost, the worse of
  the newest sample's and the running mean's. So a rate that fell shows in the first late packet.

A packet in flight that is overdue raises the cost before its answer does. No clock is read:
``now_ns`` is an argument, from any clock that does not run backwards.

A packet that takes twice as long as one as large before it speaks of a rate that fell, or of a
stall: TCP that repairs a loss. It counts at once, and what was known before it is set aside. The
next that is large enough to tell decides: if it is as quick as before, there was a stall, and the
slow one is forgotten.

An answer may wait on the way back behind bytes that the vehicle itself downloads. It still proves
what was delivered within its whole round trip, but only the time beyond that wait counts as cost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace

from rfcore.errors import InvalidInput

FIRST_NS_PER_BYTE = 8_000.0
"""Before the first answer: 1 Mbit/s, which every access network that carries video has."""

MIN_RTT_WINDOW_NS = 10_000_000_000
"""Routes and radio cells change; a shortest round trip older than 10 s is forgotten."""

DELIVERY_SAMPLES = 32
"""Answers from which the proven rate is taken: three seconds at 10 Hz. Of fewer, a second of small
frames would forget what larger ones have proven."""

MEAN_MEMORY = 0.7
"""Weight of the running mean so far, when an answer comes."""

TELLING_SIZE = 0.5
"""Share of the mean size from which one packet alone may raise the cost; less drowns in jitter."""


@dataclass(frozen=True)
class PacketInFlight:
    """A packet without an answer yet."""

    size_bytes: int
    sent_ns: int


@dataclass(frozen=True)
class DeliverySample:
    """An answered packet; ``rtt_ns`` excludes the wait behind the packets before it.

    ``own_ns``: so much of it at most the answer waited behind the vehicle's own downloads.
    """

    size_bytes: int
    rtt_ns: int
    at_ns: int
    own_ns: int = 0
    is_stall: bool = False
    """It may be a stall: it was the first that is slower than those before it."""
    longest_ns: int = 0
    """``rtt_ns``, or more of it where the answer before waited behind the vehicle's own downloads:
    the path may have begun with this packet so much earlier."""

    @property
    def bytes_per_ns(self) -> float:
        """The rate that the answer proves."""
        return self.size_bytes / max(self.rtt_ns, self.longest_ns)


@dataclass(frozen=True)
class Knowledge:
    """The samples and means before a packet of ``size_bytes`` that may have been stalled."""

    samples: tuple[DeliverySample, ...]
    means: tuple[float, float, float]
    size_bytes: int


def _no_downloads(since_ns: int, until_ns: int) -> int:  # noqa: ARG001
    return 0


class PathEstimator:
    """Estimates from the packets ``sent``, ``answered`` and ``lost`` the ``room_bytes`` of others.

    Packets are answered in the order in which they were sent; ``key`` names one.
    ``own_wait_ns`` returns how long an answer to what was sent at the first time, not there before
    the second, can have waited behind the vehicle's own downloads.
    """

    def __init__(self, own_wait_ns: Callable[[int, int], int] = _no_downloads) -> None:
        self._own_wait_ns = own_wait_ns
        self._in_flight: dict[Hashable, PacketInFlight] = {}
        self._samples: deque[DeliverySample] = deque(maxlen=DELIVERY_SAMPLES)
        self._shortest: deque[DeliverySample] = deque()
        """Samples of the window that none after them undercuts: the first has the minimum."""
        self._answered_ns: int | None = None
        self._answered_own_ns = 0
        """As much as the last answer may have waited behind the vehicle's own downloads."""
        self._means = (0.0, 0.0, 0.0)
        """Running means of size, of its square, and of size times round trip."""
        self._before_stall: Knowledge | None = None

    @property
    def bytes_in_flight(self) -> int:
        """Bytes sent and not answered."""
        return sum(packet.size_bytes for packet in self._in_flight.values())

    @property
    def min_rtt_ns(self) -> int:
        """The shortest round trip of the last seconds; 0 before any."""
        return self._shortest[0].rtt_ns if self._shortest else 0

    @property
    def rate_bps(self) -> float | None:
        """Bits per second that the last answers prove, all of their round trips counted as
        transmission: no more than the path has. None before the first answer."""
        if not self._samples:
            return None
        return 8e9 * self._proven()

    def sent(self, key: Hashable, size_bytes: int, now_ns: int) -> None:
        """Note that a packet of ``size_bytes`` went out."""
        if size_bytes < 1:
            raise InvalidInput("packet.size_bytes", f"{size_bytes} must be at least 1")
        self._in_flight[key] = PacketInFlight(size_bytes, now_ns)

    def grew(self, key: Hashable, size_bytes: int, idle_ns: int) -> None:
        """Note ``size_bytes`` more that count as one packet with ``key``.

        They went out after the path had nothing of it to carry for ``idle_ns``.
        """
        packet = self._in_flight[key]
        whole = PacketInFlight(packet.size_bytes + size_bytes, packet.sent_ns + idle_ns)
        self._in_flight[key] = whole

    def lost(self, key: Hashable) -> None:
        """Forget a packet: no answer will come, or one that says nothing of the path."""
        self._in_flight.pop(key, None)

    def answered(self, key: Hashable, now_ns: int) -> DeliverySample | None:
        """Note that the answer to ``key`` came, and return what it says; None: unknown key."""
        packet = self._in_flight.pop(key, None)
        if packet is None:
            return None
        start_ns = self._start_ns(packet, self._answered_ns)
        rtt_ns = max(1, now_ns - start_ns)
        own_ns = min(rtt_ns, self._own_wait_ns(start_ns, now_ns))
        earliest_ns = max(packet.sent_ns, start_ns - self._answered_own_ns)
        longest_ns = now_ns - earliest_ns
        self._answered_own_ns = min(longest_ns, self._own_wait_ns(earliest_ns, now_ns))
        self._answered_ns = now_ns
        sample = DeliverySample(packet.size_bytes, rtt_ns, now_ns, own_ns, longest_ns=longest_ns)
        return self._add(sample)

    def room_bytes(self, ready_ns: int, due_ns: int, now_ns: int, share: float = 1.0) -> float:
        """Return how large a packet sent at ``ready_ns`` may be to be answered by ``due_ns``.

        ``share``: the part that may be used of the time beyond the shortest round trip. 0 or less
        when even an empty packet would be late.
        """
        cost, free_ns = self._outlook(now_ns)
        spare_ns: float = due_ns - max(ready_ns, free_ns - self.min_rtt_ns)
        spare_ns -= (1 - share) * max(0.0, spare_ns - self.min_rtt_ns)
        room = (spare_ns - self.min_rtt_ns) / cost if cost else float("inf")
        return min(room, spare_ns * self._proven())

    def sustained_bytes(self, interval_ns: float, now_ns: int) -> float:
        """Return how large packets may be that go out every ``interval_ns`` for ever."""
        cost, _ = self._outlook(now_ns)
        return interval_ns / cost if cost else float("inf")

    def _proven(self) -> float:
        """Return the bytes per nanosecond that the last answers prove, or that are assumed."""
        if not self._samples:
            return 1 / FIRST_NS_PER_BYTE
        return max(sample.bytes_per_ns for sample in self._samples)

    def _add(self, sample: DeliverySample) -> DeliverySample:
        before = self._before_stall
        if before is not None and sample.size_bytes >= TELLING_SIZE * before.size_bytes:
            self._before_stall = None
            if not _outdates(sample, before.samples):
                self._samples.extend(before.samples)
                self._means = before.means
        elif before is None and _outdates(sample, self._samples):
            self._before_stall = Knowledge(tuple(self._samples), self._means, sample.size_bytes)
            sample = replace(sample, is_stall=True)
            self._samples.clear()
        if not sample.own_ns or sample.bytes_per_ns > self._proven():
            self._samples.append(sample)
        if not sample.own_ns or sample.rtt_ns < self.min_rtt_ns:
            self._add_shortest(sample)
        size, keep = float(sample.size_bytes), MEAN_MEMORY if self._means[0] else 0.0
        found = size, size**2, size * (sample.rtt_ns - sample.own_ns)
        bytes_, squares, products = (
            keep * mean + (1 - keep) * new for mean, new in zip(self._means, found, strict=True)
        )
        self._means = bytes_, squares, products
        return sample

    def _add_shortest(self, sample: DeliverySample) -> None:
        while self._shortest and self._shortest[-1].rtt_ns >= sample.rtt_ns:
            self._shortest.pop()
        self._shortest.append(sample)
        while self._shortest[0].at_ns < sample.at_ns - MIN_RTT_WINDOW_NS:
            self._shortest.popleft()

    def _cost(self) -> float:
        """Return nanoseconds per byte beyond the shortest round trip: the slope of the line of
        least squares from there. Large packets tell it, small ones are as long for other reasons.
        """
        if not self._samples:
            return FIRST_NS_PER_BYTE
        mean_bytes, mean_square, mean_product = self._means
        cost = max(0.0, mean_product - self.min_rtt_ns * mean_bytes) / mean_square
        newest = self._samples[-1]
        if newest.size_bytes >= TELLING_SIZE * mean_square / mean_bytes:
            beyond_ns = newest.rtt_ns - newest.own_ns - self.min_rtt_ns
            cost = max(cost, beyond_ns / newest.size_bytes)
        return cost

    def _outlook(self, now_ns: int) -> tuple[float, int]:
        """Return the cost per byte, and when all that is in flight will have been answered."""
        cost, free_ns = self._cost(), self._answered_ns
        for packet in self._in_flight.values():
            start_ns = self._start_ns(packet, free_ns)
            free_ns = start_ns + self.min_rtt_ns + round(cost * packet.size_bytes)
            overdue_ns = now_ns - free_ns - self._own_wait_ns(start_ns, now_ns)
            if overdue_ns > 0:
                cost = max(
                    cost, (free_ns + overdue_ns - start_ns - self.min_rtt_ns) / packet.size_bytes
                )
                free_ns = now_ns + overdue_ns
        return cost, now_ns if free_ns is None else free_ns

    def _start_ns(self, packet: PacketInFlight, before_ns: int | None) -> int:
        """Return when the path began with ``packet``: when it was sent, or when the packet before
        it, answered at ``before_ns``, had left the bottleneck."""
        if before_ns is None:
            return packet.sent_ns
        return max(packet.sent_ns, before_ns - self.min_rtt_ns)


def _outdates(sample: DeliverySample, others: Iterable[DeliverySample]) -> bool:
    """Return whether a packet no larger than an earlier one took twice its time or more."""
    return any(
        other.size_bytes >= sample.size_bytes and 2 * other.rtt_ns <= sample.rtt_ns - sample.own_ns
        for other in others
    )
