"""One direction of the link in real time: an ``rfcore.link`` state machine, driven by a task.

Packets are callbacks: what is pushed is called when it is due.

``LinkMetrics`` reads both directions for Prometheus; all its names begin with ``rfedge_link_``.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rfcore.link.plan import DirectionPlan
from rfcore.link.shaper import BusyMeter, Link
from rfcore.wire.instruments import Family, Instruments

__all__ = ["SPIN_S", "Direction", "LinkMetrics", "Sender"]

SPIN_S = 0.0002
"""Time before a release at which the pump stops sleeping and yields in a loop: the kernel's timer
slack of 50 us and the loop's own time. Longer would make the scheduler see a busy process and
interrupt it just when it matters. Many links in one process would spin all the time, so they use
0."""


class Sender(Protocol):
    """Pushes into a direction, and can be made to wait."""

    def hold(self, reason: str) -> None:
        """Push nothing until ``resume`` with the same reason."""

    def resume(self, reason: str) -> None:
        """Push again, if no other reason holds."""

    def abort(self) -> None:
        """Push nothing any more."""


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
        plan: DirectionPlan,
        transit: Callable[[float], None] = _ignore,
        spin_s: float = SPIN_S,
    ) -> None:
        self.meter = BusyMeter()
        self.senders: set[Sender] = set()
        self.profile = plan.profile
        self._transit = transit
        self._spin_s = spin_s
        self._link: Link[Packet] = plan.link(time.perf_counter())
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

    def push(self, release: Callable[[], None], size_bytes: int) -> None:
        """Call ``release`` when ``size_bytes`` have passed the link."""
        now = time.perf_counter()
        self._link.push(Packet(release, now), size_bytes, now)
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
            delivery.item.release()
            released_s = time.perf_counter()
            self.meter.released(delivery, released_s)
            if delivery.size_bytes:
                self._transit(released_s - delivery.item.pushed_s)

    def report(self) -> dict[str, float | int | None]:
        """Return what was measured."""
        meter = self.meter
        return {
            "rate_bps": self.profile.rate_bps,
            "delay_s": self.profile.delay_s,
            "bytes": meter.wire_bytes,
            "busy_s": meter.busy_s,
            "expected_s": meter.expected_s,
            "tau_error_percent": meter.tau_error_percent,
            "busy_periods": meter.periods,
            "largest_lateness_s": meter.largest_lateness_s,
        }


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
