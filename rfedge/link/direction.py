"""One direction of the link in real time: an ``rfcore.link`` state machine, driven by a task.

Packets are callbacks: what is pushed is called when it is due.

``Side`` is one end of one connection through the link, as an asyncio protocol. ``LinkMetrics``
reads both directions for Prometheus; all its names begin with ``rfedge_link_``.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rfcore.link.lossy import LossyLink
from rfcore.link.shaper import BusyMeter, Connection, Link
from rfcore.wire.instruments import Family, Instruments
from rfedge.link import SPIN_S

SEGMENT_BYTES = 4096
"""Bytes released at once: 8 ms at 4 Mbit/s, so that a long message does not arrive in one lump."""

READ_BYTES = 16 * 1024
SOCKET_BUFFER_BYTES = 64 * 1024


@dataclass(frozen=True)
class Packet:
    """A callback for the end of the link, and the time at which it was pushed."""

    release: Callable[[], None]
    pushed_s: float


def _ignore(transit_s: float) -> None:
    """Do nothing."""


class Direction:
    """One direction of the link: senders push, the pump releases to receivers on time."""

    def __init__(
        self,
        link: Link[Packet] | LossyLink[Packet],
        transit: Callable[[float], None] = _ignore,
        spin_s: float = SPIN_S,
    ) -> None:
        self.meter = BusyMeter()
        self.senders: set[Side] = set()
        self.profile = link.profile
        self._transit = transit
        self._spin_s = spin_s
        self._link = link
        self._loses = isinstance(link, LossyLink)
        """Packets that are sent again keep the link busy, too: its accuracy cannot be told."""
        self._arrived = asyncio.Event()
        self._holding = False

    @property
    def room_bytes(self) -> int:
        """Return the bytes that may still be pushed."""
        return self._link.room_bytes(time.perf_counter())

    @property
    def held_bytes(self) -> int:
        """Return the bytes in the link."""
        return self._link.held_bytes

    def push(
        self, release: Callable[[], None], size_bytes: int, connection: Connection | None = None
    ) -> None:
        """Call ``release`` when ``size_bytes`` of a connection have passed the link."""
        now = time.perf_counter()
        self._link.push(Packet(release, now), size_bytes, now, connection)
        self._arrived.set()
        if self._link.is_full(now):
            self._holding = True
            for sender in self.senders:
                sender.hold("link")

    async def pump(self) -> None:
        """Release packets when they are due, for ever."""
        while True:
            next_s = self._next_event_at()
            if next_s is None:
                self._arrived.clear()
                await self._arrived.wait()
                continue
            await _sleep_until(next_s, self._spin_s)
            self._release(time.perf_counter())
            if self._holding and not self._link.is_full(time.perf_counter()):
                self._holding = False
                for sender in self.senders:
                    sender.resume("link")

    def _next_event_at(self) -> float | None:
        """Return when a packet is due, or senders that are held may go on."""
        events = [self._link.next_event_at(), self._link.room_at() if self._holding else None]
        return min((event for event in events if event is not None), default=None)

    def _release(self, now: float) -> None:
        for delivery in self._link.pop_due(now):
            packets = delivery.item if isinstance(delivery.item, tuple) else (delivery.item,)
            for packet in packets:
                packet.release()
            released_s = time.perf_counter()
            self.meter.released(delivery, released_s)
            if delivery.size_bytes:
                for packet in packets:
                    self._transit(released_s - packet.pushed_s)

    def report(self) -> dict[str, float | int | None]:
        """Return what was measured."""
        meter = self.meter
        return {
            "rate_bps": self.profile.rate_bps,
            "delay_s": self.profile.delay_s,
            "bytes": meter.wire_bytes,
            "busy_s": meter.busy_s,
            "expected_s": meter.expected_s,
            "tau_error_percent": None if self._loses else meter.tau_error_percent,
            "busy_periods": meter.periods,
            "largest_lateness_s": meter.largest_lateness_s,
        }


class Side(asyncio.BufferedProtocol, Connection):
    """One end of one connection: what it sends goes into ``outward``, to ``peer``."""

    def __init__(self, outward: Direction, ended: Callable[[], None]) -> None:
        self.peer: Side | None = None
        self.transport: asyncio.Transport | None = None
        self._outward = outward
        self._ended = ended
        self._buffer = bytearray(READ_BYTES)
        self._held: set[str] = set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Wait for the other end before reading anything; asyncio has set TCP_NODELAY."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        transport.set_write_buffer_limits(SOCKET_BUFFER_BYTES)
        self._outward.senders.add(self)
        self.hold("peer")

    def join(self, peer: Side) -> None:
        """Send what comes in here to ``peer``."""
        self.peer = peer
        self.resume("peer")

    def hold(self, reason: str) -> None:
        """Stop reading until ``reason`` is gone."""
        if not self._held and self.transport is not None:
            self.transport.pause_reading()
        self._held.add(reason)

    def resume(self, reason: str) -> None:
        """Read again if ``reason`` was the last one against it."""
        if self._held == {reason} and self.transport is not None:
            self.transport.resume_reading()
        self._held.discard(reason)

    def abort(self) -> None:
        """Close at once."""
        if self.transport is not None:
            self.transport.abort()

    @property
    def is_open(self) -> bool:
        """Return whether the socket is connected and not being closed."""
        return self.transport is not None and not self.transport.is_closing()

    def bound_receive_buffer(self) -> None:
        """Limit the kernel's buffer, which would hide seconds of data behind the link's queue."""
        if self.transport is not None:
            sock = self.transport.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002
        """Offer no more than the link has room for."""
        return memoryview(self._buffer)[: max(1, min(READ_BYTES, self._outward.room_bytes))]

    def buffer_updated(self, nbytes: int) -> None:
        """Push what came in, in segments."""
        data = bytes(self._buffer[:nbytes])
        for start in range(0, nbytes, SEGMENT_BYTES):
            segment = data[start : start + SEGMENT_BYTES]
            self._outward.push(lambda part=segment: self._deliver(part), len(segment), self)  # type: ignore[misc]

    def eof_received(self) -> bool:
        """Pass the end on behind the data; keep our own direction open."""
        self._outward.push(self._deliver_end, 0, self)
        return True

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002
        """Take the other end down too, after what is under way."""
        self._outward.senders.discard(self)
        self._outward.push(self._close_peer, 0, self)
        self._ended()

    def pause_writing(self) -> None:
        """Stop the other end, since our socket takes no more."""
        if self.peer is not None:
            self.peer.hold("receiver")

    def resume_writing(self) -> None:
        """Let the other end go on, since our socket takes data again."""
        if self.peer is not None:
            self.peer.resume("receiver")

    def _deliver(self, data: bytes) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.write(data)

    def _deliver_end(self) -> None:
        transport = self.peer.transport if self.peer is not None else None
        if transport is not None and transport.can_write_eof() and not transport.is_closing():
            with suppress(OSError):  # the other end is gone, and the event loop did not hear of it
                transport.write_eof()

    def _close_peer(self) -> None:
        if self.peer is not None and self.peer.transport is not None:
            self.peer.transport.close()


async def _sleep_until(due_s: float, spin_s: float) -> None:
    ahead_s = due_s - time.perf_counter() - spin_s
    if ahead_s > 0:
        await asyncio.sleep(ahead_s)
    while time.perf_counter() < due_s:
        await asyncio.sleep(0)


class LinkMetrics:
    """Metrics of both directions; what the directions count themselves is read at each scrape."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.instruments = make = Instruments(registry)
        make.process()
        self._transit = make.seconds(
            "rfedge_link_transit_seconds",
            "From a segment's arrival at the link to its release: queue, transmission, delay.",
            ("direction",),
        )
        self.connections = make.gauge("rfedge_link_connections", "Connections that are open.")
        self.cut = make.counter("rfedge_link_connections_cut", "Connections cut by the profile.")
        self._directions: dict[str, Direction] = {}
        for family, read in READ:
            make.collector(family, _Reading(family, read, self._directions))

    def transit(self, direction: str) -> Callable[[float], None]:
        """Return the function to call with the time of each segment in the link."""
        return self._transit.labels(direction).observe

    def observe(self, directions: Mapping[str, Direction]) -> None:
        """Read these directions from now on."""
        self._directions.update(directions)


def _family(name: str, kind: str, text: str) -> Family:
    return Family(name, kind, text, ("direction",))


READ: tuple[tuple[Family, Callable[[Direction], float]], ...] = (
    (
        _family("rfedge_link_bytes_total", "counter", "Bytes that came out, HTTP/2 and all."),
        lambda direction: direction.meter.wire_bytes,
    ),
    (
        _family("rfedge_link_busy_seconds_total", "counter", "Time spent transmitting."),
        lambda direction: direction.meter.busy_s,
    ),
    (
        _family("rfedge_link_held_bytes", "gauge", "Bytes in the link: waiting or under way."),
        lambda direction: direction.held_bytes,
    ),
    (
        _family("rfedge_link_rate_bytes_per_second", "gauge", "Rate; of a trace, its mean."),
        lambda direction: direction.profile.rate_bps / 8,
    ),
    (
        _family(
            "rfedge_link_lateness_max_seconds",
            "gauge",
            "The latest release so far, against the moment it was due.",
        ),
        lambda direction: direction.meter.largest_lateness_s,
    ),
)


class _Reading(Collector):
    """One metric, read from the directions at the moment of a scrape."""

    def __init__(
        self,
        family: Family,
        read: Callable[[Direction], float],
        directions: Mapping[str, Direction],
    ) -> None:
        self._family = family
        self._read = read
        self._directions = directions

    def describe(self) -> Iterable[Metric]:
        """Return the metric without values."""
        return [self._empty()]

    def collect(self) -> Iterable[Metric]:
        """Return the metric with a value for each direction."""
        metric = self._empty()
        for name, direction in self._directions.items():
            metric.add_metric([name], self._read(direction))
        return [metric]

    def _empty(self) -> CounterMetricFamily | GaugeMetricFamily:
        kind = CounterMetricFamily if self._family.kind == "counter" else GaugeMetricFamily
        name = self._family.name.removesuffix("_total")
        return kind(name, self._family.text, labels=list(self._family.labels))
