"""Metrics of a process: declared in one way, on one registry, and listable for the documents.

Names follow Prometheus: ``rfedge_`` first, base units (seconds, bytes) at the end; counters get
their ``_total`` from the client library. Help is one sentence. Histograms of time have their
buckets at the frame budgets.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
)
from prometheus_client.registry import Collector

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
        """Declare a distribution of seconds."""
        self._declare(Family(name, "histogram", text, tuple(labels)))
        return Histogram(name, text, labels, buckets=FRAME_BUDGET_BUCKETS_S, registry=self.registry)

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
