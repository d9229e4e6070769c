"""What a path takes, from when packets were sent and when their answers came.

A path delays a packet of B bytes by ``base + B * cost`` after the packets before it; ``base`` is
propagation, answer and the receiver's own time. Nobody tells the two apart: packets much like one
another fit any base from 0 to the shortest delay seen. So both ends of that range are asked, and
the smaller answer counts:

* base 0: a packet that took T for B bytes proves that B * X / T bytes take no longer than X, for
  any X >= T. So quality climbs by what was proven, a frame at a time.
* base = the shortest delay of the last seconds: what is beyond it is cost, the worse of the newest
  packet's and the running mean's. So a rate that fell is believed at the first late packet.

An unanswered packet that is overdue raises the cost before its answer does. A machine without
clock: ``now_ns`` is an argument, from any clock that does not run backwards.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass

from rfcore.errors import InvalidInput

__all__ = ["PathEstimator"]

FIRST_NS_PER_BYTE = 8_000.0
"""Before the first answer: 1 Mbit/s, which every access network that carries video has."""

BASE_MEMORY_NS = 10_000_000_000
"""Routes and radio cells change; a base delay older than 10 s is forgotten."""

PROOFS = 8
"""Answers that may prove what the path carries: most of a second at 10 Hz."""

MEMORY = 0.7
"""Weight of what was known, when an answer comes."""

WEIGHTY = 0.5
"""Share of the mean size from which one packet alone may tell the cost: jitter drowns less."""


@dataclass(frozen=True)
class _Flying:
    size_bytes: int
    sent_ns: int


@dataclass(frozen=True)
class _Seen:
    size_bytes: int
    delay_ns: int
    at_ns: int


class PathEstimator:
    """Tell it of every packet ``sent``, and of its answer or its loss; ask it for ``room_bytes``.

    Packets are answered in the order they were sent; ``key`` names one.
    """

    def __init__(self) -> None:
        self._flying: dict[Hashable, _Flying] = {}
        self._proofs: deque[_Seen] = deque(maxlen=PROOFS)
        self._shortest: deque[_Seen] = deque()
        self._answered_ns: int | None = None
        self._mean_bytes = 0.0
        self._mean_delay_ns = 0.0

    @property
    def flying_bytes(self) -> int:
        """Bytes sent and not answered."""
        return sum(packet.size_bytes for packet in self._flying.values())

    @property
    def base_ns(self) -> int:
        """The shortest delay of the last seconds, an upper bound of the base; 0 before any."""
        return self._shortest[0].delay_ns if self._shortest else 0

    @property
    def rate_bps(self) -> float | None:
        """Bits per second that the last answers prove, their base delay counted as transmission:
        no more than the path has. None before the first answer."""
        if not self._proofs:
            return None
        return max(8e9 * seen.size_bytes / max(seen.delay_ns, 1) for seen in self._proofs)

    def sent(self, key: Hashable, size_bytes: int, now_ns: int) -> None:
        """A packet of ``size_bytes`` went out."""
        if size_bytes < 1:
            raise InvalidInput("packet.size_bytes", f"{size_bytes} must be at least 1")
        self._flying[key] = _Flying(size_bytes, now_ns)

    def lost(self, key: Hashable) -> None:
        """No answer will come, or one that says nothing of the path; unknown keys are ignored."""
        self._flying.pop(key, None)

    def answered(self, key: Hashable, now_ns: int) -> None:
        """The answer to ``key`` came; unknown keys are ignored."""
        packet = self._flying.pop(key, None)
        if packet is None:
            return
        delay_ns = max(1, now_ns - self._start_ns(packet, self._answered_ns))
        self._answered_ns = now_ns
        self._learn(_Seen(packet.size_bytes, delay_ns, now_ns))

    def room_bytes(self, ready_ns: int, due_ns: int, now_ns: int) -> float:
        """Return how large a packet sent at ``ready_ns`` may be to be answered by ``due_ns``.

        0 or less when even an empty one would be late.
        """
        cost, free_ns = self._outlook(now_ns)
        spare_ns = due_ns - max(ready_ns, free_ns - self.base_ns)
        room = (spare_ns - self.base_ns) / cost if cost else float("inf")
        if not self._proofs:
            return min(room, spare_ns / FIRST_NS_PER_BYTE)
        proven = max(seen.size_bytes / seen.delay_ns for seen in self._proofs)
        return min(room, spare_ns * proven)

    def sustained_bytes(self, interval_ns: float, now_ns: int) -> float:
        """Return how large packets may be that go out every ``interval_ns`` for ever."""
        cost, _ = self._outlook(now_ns)
        return interval_ns / cost if cost else float("inf")

    def _learn(self, seen: _Seen) -> None:
        if self._is_surprise(seen):
            self._proofs.clear()
        self._proofs.append(seen)
        while self._shortest and self._shortest[-1].delay_ns >= seen.delay_ns:
            self._shortest.pop()
        self._shortest.append(seen)
        while self._shortest[0].at_ns < seen.at_ns - BASE_MEMORY_NS:
            self._shortest.popleft()
        keep = MEMORY if self._mean_bytes else 0.0
        self._mean_bytes = keep * self._mean_bytes + (1 - keep) * seen.size_bytes
        self._mean_delay_ns = keep * self._mean_delay_ns + (1 - keep) * seen.delay_ns

    def _is_surprise(self, seen: _Seen) -> bool:
        """Whether some larger packet took half the time or less: its proof is out of date."""
        return any(
            proof.size_bytes >= seen.size_bytes and 2 * proof.delay_ns <= seen.delay_ns
            for proof in self._proofs
        )

    def _cost(self) -> float:
        """Return nanoseconds per byte beyond the base."""
        if not self._proofs:
            return FIRST_NS_PER_BYTE
        cost = max(0.0, self._mean_delay_ns - self.base_ns) / self._mean_bytes
        newest = self._proofs[-1]
        if newest.size_bytes >= WEIGHTY * self._mean_bytes:
            cost = max(cost, (newest.delay_ns - self.base_ns) / newest.size_bytes)
        return cost

    def _outlook(self, now_ns: int) -> tuple[float, int]:
        """Return the cost per byte, and when all that flies will have been answered."""
        cost, free_ns = self._cost(), self._answered_ns
        for packet in self._flying.values():
            start_ns = self._start_ns(packet, free_ns)
            free_ns = start_ns + self.base_ns + round(cost * packet.size_bytes)
            overdue_ns = now_ns - free_ns
            if overdue_ns > 0:
                cost = max(cost, (now_ns - start_ns - self.base_ns) / packet.size_bytes)
                free_ns = now_ns + overdue_ns
        return cost, now_ns if free_ns is None else free_ns

    def _start_ns(self, packet: _Flying, before_ns: int | None) -> int:
        """Return when the path turned to ``packet``: as it was sent, or as the one before left."""
        return (
            packet.sent_ns if before_ns is None else max(packet.sent_ns, before_ns - self.base_ns)
        )
