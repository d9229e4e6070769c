"""A link that loses packets under TCP: bytes arrive late instead of never.

The link carries packets of up to 1500 bytes, headers among them, of one or more connections. Some
are lost, alone or in bursts (Gilbert 1960: a good state that delivers, a bad one that does not).
TCP (``rfcore.link.tcp``) sends them again, waits, and sends slower, and what lies behind a lost
packet of the same connection waits with it. A full queue loses packets, too.

Acknowledgements take the delay of the way back and may be lost there; its rate, outages and jitter
do not touch them. What is waited for before the link is ``queue_limit_bytes`` long, as with
``Link``.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from random import Random
from typing import Generic, NamedTuple
from weakref import WeakKeyDictionary

from rfcore.errors import InvalidInput
from rfcore.link.shaper import Connection, Delivery, Item, Link, LinkProfile
from rfcore.link.tcp import AckPacket, Receiver, Sender

HEADER_BYTES = 52
"""IPv4, TCP, and its time stamps."""
MAX_LOSS_PERCENT = 50.0


@dataclass(frozen=True)
class PacketLoss:
    """``percent`` of the packets are lost on average, ``burst`` in a row on average."""

    percent: float
    burst: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.percent <= MAX_LOSS_PERCENT:
            raise InvalidInput("loss", f"{self.percent} % is outside 0..{MAX_LOSS_PERCENT:g} %")
        if not 1 <= self.burst <= 1000:
            raise InvalidInput("loss_burst", f"{self.burst} is outside 1..1000 packets")

    def losses(self, random: Random) -> Callable[[], bool]:
        """Return a function that says of one packet after another whether it is lost."""
        share = self.percent / 100
        after_loss = 1 - 1 / self.burst if self.burst > 1 else share
        after_delivery = share if self.burst == 1 else share / (1 - share) / self.burst
        was_lost = False

        def is_lost() -> bool:
            nonlocal was_lost
            was_lost = random.random() < (after_loss if was_lost else after_delivery)
            return was_lost

        return is_lost


@dataclass
class _Stream(Generic[Item]):
    """One connection's direction, and the items that arrive with its bytes."""

    sender: Sender
    receiver: Receiver = field(default_factory=Receiver)
    items: deque[tuple[int, Item]] = field(default_factory=deque)
    sender_alarm_s: float | None = None
    receiver_alarm_s: float | None = None

    def released(self) -> tuple[Item, ...]:
        """Return, once, the items whose last byte has arrived."""
        items = []
        while self.items and self.items[0][0] <= self.receiver.upto:
            items.append(self.items.popleft()[1])
        return tuple(items)


class _Packet(NamedTuple):
    stream: _Stream  # type: ignore[type-arg]
    start: int
    end: int
    is_lost: bool


class LossyLink(Generic[Item]):
    """``Link`` for TCP over packets that are lost; ``link`` carries them.

    Items of one ``connection`` keep their order. ``pop_due`` returns a delivery for each packet
    that left the link, with the items that it completed: none for a lost one.
    """

    def __init__(
        self,
        link: Link[_Packet],
        losses: Callable[[], bool],
        ack_delay_s: float,
        ack_losses: Callable[[], bool],
    ) -> None:
        self.profile: LinkProfile = link.profile
        self._link = link
        self._losses, self._ack_losses = losses, ack_losses
        self._ack_delay_s = ack_delay_s
        self._streams: WeakKeyDictionary[Connection, _Stream[Item]] = WeakKeyDictionary()
        self._alone = Connection()
        self._events: list[tuple[float, int, Callable[[float], None]]] = []
        self._numbers = itertools.count()
        self._popped: list[Delivery[tuple[Item, ...]]] = []
        self._held_bytes = self._unsent_bytes = 0

    @property
    def held_bytes(self) -> int:
        """Bytes pushed and not yet popped."""
        return self._held_bytes

    def room_bytes(self, now: float) -> int:  # noqa: ARG002
        """Return how much may be pushed: what was never sent takes room."""
        return max(0, self.profile.queue_limit_bytes - self._unsent_bytes)

    def is_full(self, now: float) -> bool:
        """Return whether the caller should stop pushing."""
        return self.room_bytes(now) == 0

    def room_at(self) -> float | None:
        """Return when there may be room."""
        return self.next_event_at()

    def push(
        self, item: Item, size_bytes: int, now: float, connection: Connection | None = None
    ) -> None:
        """Write ``size_bytes`` to a connection; ``item`` is popped once all of them arrived."""
        if size_bytes < 0:
            raise InvalidInput("link.size_bytes", f"{size_bytes} must not be negative")
        stream = self._stream(connection or self._alone)
        stream.sender.written(size_bytes, now)
        stream.items.append((stream.sender.written_upto, item))
        self._held_bytes += size_bytes
        self._unsent_bytes += size_bytes
        if size_bytes:
            self._at(now, lambda at_s: self._send(stream, stream.sender.packets(at_s), at_s))
        else:
            self._at(now + self.profile.delay_s, lambda at_s: self._release(stream, at_s))

    def pop_due(self, now: float) -> list[Delivery[tuple[Item, ...]]]:
        """Let time pass until ``now``; return the packets that left the link meanwhile."""
        while self._events and self._events[0][0] <= now:
            at_s, _, happen = heapq.heappop(self._events)
            happen(at_s)
        popped, self._popped = self._popped, []
        return popped

    def next_event_at(self) -> float | None:
        """Return when something happens next, or None when the link is empty."""
        return self._events[0][0] if self._events else None

    def _stream(self, connection: Connection) -> _Stream[Item]:
        if connection not in self._streams:
            rtt_s = self.profile.delay_s + self._ack_delay_s
            self._streams[connection] = _Stream(Sender(rtt_s))
        return self._streams[connection]

    def _at(self, at_s: float, happen: Callable[[float], None]) -> None:
        heapq.heappush(self._events, (at_s, next(self._numbers), happen))

    def _send(self, stream: _Stream[Item], packets: Iterable[tuple[int, int]], now: float) -> None:
        before = stream.sender.sent_upto
        for start, end in packets:
            size_bytes = end - start + HEADER_BYTES
            is_lost = self._losses()
            if self._link.is_full(now):
                continue
            packet = _Packet(stream, start, end, is_lost)
            delivery = self._link.push(packet, size_bytes, now)
            self._at(delivery.due_s, self._arrive)
        self._unsent_bytes -= stream.sender.sent_upto - before
        self._set_alarm(stream)

    def _arrive(self, now: float) -> None:
        for delivery in self._link.pop_due(now):
            stream, start, end, is_lost = delivery.item
            items: tuple[Item, ...] = ()
            if not is_lost:
                ack = self._receive(stream, start, end, now)
                items = stream.released()
                if ack is not None:
                    self._acknowledge(stream, ack, now)
            times = (delivery.start_s, delivery.end_s, delivery.due_s)
            self._popped.append(Delivery(items, delivery.size_bytes, *times))

    def _receive(self, stream: _Stream[Item], start: int, end: int, now: float) -> AckPacket | None:
        before = stream.receiver.upto
        ack = stream.receiver.received(start, end, now)
        self._held_bytes -= stream.receiver.upto - before
        if stream.receiver.timer_s is not None:
            self._at(stream.receiver.timer_s, lambda at_s: self._acknowledge_late(stream, at_s))
        return ack

    def _release(self, stream: _Stream[Item], now: float) -> None:
        """Pop items without bytes, unless bytes before them are under way."""
        items = stream.released()
        if items:
            self._popped.append(Delivery(items, 0, now, now, now))

    def _acknowledge(self, stream: _Stream[Item], ack: AckPacket, now: float) -> None:
        if self._ack_losses():
            return

        def acked(at_s: float) -> None:
            stream.sender.acked(ack, at_s)
            self._send(stream, stream.sender.packets(at_s), at_s)

        self._at(now + self._ack_delay_s, acked)

    def _acknowledge_late(self, stream: _Stream[Item], now: float) -> None:
        if stream.receiver.timer_s is not None and stream.receiver.timer_s <= now:
            self._acknowledge(stream, stream.receiver.acknowledgement(), now)

    def _set_alarm(self, stream: _Stream[Item]) -> None:
        """Have the sender's timer run out in time; an alarm that is too early looks again."""
        timer_s, alarm_s = stream.sender.timer_s, stream.sender_alarm_s
        if timer_s is None or (alarm_s is not None and alarm_s <= timer_s):
            return
        stream.sender_alarm_s = timer_s
        self._at(timer_s, lambda at_s: self._alarm(stream, at_s))

    def _alarm(self, stream: _Stream[Item], now: float) -> None:
        if stream.sender_alarm_s != now:
            return  # an earlier one was set after it
        stream.sender_alarm_s = None
        timer_s = stream.sender.timer_s
        if timer_s is not None and timer_s <= now:
            self._send(stream, stream.sender.expired(now), now)
        else:
            self._set_alarm(stream)
