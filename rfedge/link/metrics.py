"""The Prometheus metrics of ``rfedge link``. All names begin with ``rfedge_link_``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from rfcore.wire.instruments import Family, Instruments
from rfedge.link.direction import Direction

__all__ = ["LinkMetrics"]


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
