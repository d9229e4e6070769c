"""Metrics of a process: declared in one way, on one registry, and listable for the documents.

Names follow Prometheus: ``rfedge_`` first, base units (seconds, bytes) at the end; counters get
their ``_total`` from the client library. Help is one sentence. Histograms of time have their
buckets at the frame budgets.
"""

from __future__ import annotations

import platform
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import accumulate

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
)
from prometheus_client.registry import Collector
from prometheus_client.samples import Sample
from prometheus_client.utils import floatToGoString

from rfcore.errors import InvalidInput
from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S, RENDERER_CONTRACT

__all__ = ["Family", "Instruments"]


@dataclass(frozen=True)
class Family:
    """One metric as Prometheus shows it: ``name`` with its ending, ``kind``, help, label names."""

    name: str
    kind: str
    text: str
    labels: tuple[str, ...] = ()


class Seconds(Histogram):
    """A histogram observed from one thread: neither locks nor walks through its buckets.

    A frame is observed six times over; prometheus_client's own takes 3.1 us each on a machine where
    this takes 0.5.
    """

    def _metric_init(self) -> None:
        self._counts = [0] * len(self._upper_bounds)
        self._total_s = 0.0

    def observe(self, amount: float, exemplar: dict[str, str] | None = None) -> None:
        """Count ``amount`` seconds; exemplars are not kept."""
        del exemplar
        self._counts[bisect_left(self._upper_bounds, amount)] += 1
        self._total_s += amount

    def _child_samples(self) -> Iterable[Sample]:
        reached = list(accumulate(self._counts))
        bounds = map(floatToGoString, self._upper_bounds)
        for bound, count in zip(bounds, reached, strict=True):
            yield Sample("_bucket", {"le": bound}, count, None, None)
        yield Sample("_count", {}, reached[-1], None, None)
        yield Sample("_sum", {}, self._total_s, None, None)


class Instruments:
    """Makes metrics on ``registry`` and remembers what it made in ``families``."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.registry = registry
        self.families: list[Family] = []

    def counter(self, name: str, text: str, labels: Sequence[str] = ()) -> Counter:
        """Declare what only grows; ``name`` is without ``_total``."""
        self._declare(Family(f"{name}_total", "counter", text, tuple(labels)))
        return Counter(name, text, labels, registry=self.registry)

    def gauge(self, name: str, text: str, labels: Sequence[str] = ()) -> Gauge:
        """Declare what goes up and down."""
        self._declare(Family(name, "gauge", text, tuple(labels)))
        return Gauge(name, text, labels, registry=self.registry)

    def seconds(self, name: str, text: str, labels: Sequence[str] = ()) -> Histogram:
        """Declare a distribution of seconds, observed from one thread."""
        self._declare(Family(name, "histogram", text, tuple(labels)))
        return Seconds(name, text, labels, buckets=FRAME_BUDGET_BUCKETS_S, registry=self.registry)

    def info(self, name: str, text: str, values: Mapping[str, str]) -> None:
        """Declare a metric that is always 1 and says something in its labels."""
        self.gauge(name, text, tuple(values)).labels(**values).set(1)

    def collector(self, family: Family, collector: Collector) -> None:
        """Declare a metric that is computed when it is asked for."""
        self._declare(family)
        self.registry.register(collector)

    def process(self) -> None:
        """Declare what this process is and what it uses: CPU, memory, descriptors."""
        build = {
            "version": version("rfedge"),
            "renderer_contract": RENDERER_CONTRACT,
            "python": platform.python_version(),
        }
        self.info("rfedge_build_info", "1; what is running, in its labels.", build)
        for name, kind, text in PROCESS_FAMILIES:
            self.families.append(Family(name, kind, text))
        ProcessCollector(registry=self.registry)

    def _declare(self, family: Family) -> None:
        if not family.name.startswith("rfedge_"):
            raise InvalidInput("metric.name", f"{family.name} must begin with rfedge_")
        if not family.text.endswith("."):
            raise InvalidInput("metric.text", f"help of {family.name} must be a sentence")
        if family.kind == "histogram" and not family.name.endswith("_seconds"):
            raise InvalidInput("metric.name", f"{family.name} holds time; end it in _seconds")
        self.families.append(family)


PROCESS_FAMILIES = (
    ("process_cpu_seconds_total", "counter", "Total user and system CPU time spent in seconds."),
    ("process_max_fds", "gauge", "Maximum number of open file descriptors."),
    ("process_open_fds", "gauge", "Number of open file descriptors."),
    ("process_resident_memory_bytes", "gauge", "Resident memory size in bytes."),
    (
        "process_start_time_seconds",
        "gauge",
        "Start time of the process since unix epoch in seconds.",
    ),
    ("process_virtual_memory_bytes", "gauge", "Virtual memory size in bytes."),
)
"""What prometheus_client's own ``ProcessCollector`` adds on Linux."""
