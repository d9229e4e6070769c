"""The metrics of a process: declared on one registry, listed for the documents, served over HTTP.

Names follow Prometheus: ``rfedge_`` first, base units (seconds, bytes) at the end; counters get
their ``_total`` from the client library. The help text is one sentence. Histograms of time have
their buckets at the frame budgets.
"""

from __future__ import annotations

import platform
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from http.server import ThreadingHTTPServer
from importlib.metadata import version
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import MetricsHandler
from prometheus_client.registry import Collector

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.raster.renderers import DEVICES, DeviceRecord
from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S, RENDERER_CONTRACT


@dataclass(frozen=True)
class Family:
    """One metric as Prometheus shows it: ``name`` with its ending, ``kind``, help, label names."""

    name: str
    kind: str
    text: str
    labels: tuple[str, ...] = ()


Readings = Mapping[tuple[str, ...], float]
"""Values of a metric by the values of its labels."""


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
        """Declare a distribution of seconds, with buckets at the frame budgets."""
        self._declare(Family(name, "histogram", text, tuple(labels)))
        buckets = FRAME_BUDGET_BUCKETS_S
        return Histogram(name, text, labels, registry=self.registry, buckets=buckets)

    def info(self, name: str, text: str, values: Mapping[str, str]) -> None:
        """Declare a metric that is always 1 and says something in its labels."""
        self.gauge(name, text, tuple(values)).labels(**values).set(1)

    def collector(self, family: Family, collector: Collector) -> None:
        """Declare a metric that is computed when it is asked for."""
        self._declare(family)
        self.registry.register(collector)

    def read(
        self, name: str, text: str, labels: Sequence[str], values: Callable[[], Readings]
    ) -> None:
        """Declare a counter (``name`` ends in ``_total``) or gauge whose ``values`` are read."""
        kind = "counter" if name.endswith("_total") else "gauge"
        family = Family(name, kind, text, tuple(labels))
        self.collector(family, _Read(family, values))

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

    def devices(self, record: DeviceRecord = DEVICES) -> None:
        """Declare which OpenCL devices were opened and how often the CPU stood in for one."""
        self.read(
            "rfedge_opencl_device_info",
            "1 for each OpenCL device that passed its self-check and was opened.",
            ("device", "driver", "build"),
            lambda: dict.fromkeys(list(record.opened), 1.0),
        )
        self.read(
            "rfedge_opencl_fallbacks_total",
            "Times the CPU drew instead: lost (a device failed, for good), full (one picture).",
            ("reason",),
            lambda: {("lost",): record.lost, ("full",): record.full},
        )

    def _declare(self, family: Family) -> None:
        if not family.name.startswith("rfedge_"):
            raise InvalidInput("metric.name", f"{family.name} must begin with rfedge_")
        if not family.text.endswith("."):
            raise InvalidInput("metric.text", f"help of {family.name} must be a sentence")
        if family.kind == "histogram" and not family.name.endswith("_seconds"):
            raise InvalidInput("metric.name", f"{family.name} holds time; end it in _seconds")
        self.families.append(family)


class _Read(Collector):
    """A metric whose values are read from elsewhere at each scrape."""

    def __init__(self, family: Family, values: Callable[[], Readings]) -> None:
        self._family = family
        self._values = values

    def describe(self) -> Iterable[Metric]:
        return [self._empty()]

    def collect(self) -> Iterable[Metric]:
        metric = self._empty()
        for labels, value in self._values().items():
            metric.add_metric(labels, value)
        return [metric]

    def _empty(self) -> CounterMetricFamily | GaugeMetricFamily:
        name, kind, text, labels = astuple(self._family)
        made = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
        return made(name, text, labels=labels)


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
"""Metrics that prometheus_client's own ``ProcessCollector`` adds on Linux."""


MAX_SCRAPES = 8
"""Connections that are served at once; each takes a thread, further ones are closed."""

SCRAPE_S = 5.0
"""Longest time of a scrape, from its connection on."""


class _BoundedServer(ThreadingHTTPServer):
    """A thread a connection, a few at once, none for longer than ``SCRAPE_S``."""

    daemon_threads = True

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        self._open: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__((host, port), _QuietHandler.factory(registry))

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection on a thread of its own, or close it if there are too many."""
        with self._lock:
            if len(self._open) >= MAX_SCRAPES:
                self.shutdown_request(request)
                return
            self._open[request] = time.monotonic() + SCRAPE_S
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one connection to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)

    def service_actions(self) -> None:
        """Cut connections that are over their time; called twice a second."""
        now = time.monotonic()
        with self._lock:
            late = [request for request, until_s in self._open.items() if now > until_s]
        for request in late:
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of connections that broke: a peer must not fill the log."""


class _QuietHandler(MetricsHandler):
    timeout = SCRAPE_S

    def log_message(self, *_: Any) -> None:
        """Say nothing of requests."""


class MetricsEndpoint:
    """Serves the metrics of ``registry`` at ``http://host:port/metrics`` until ``close``.

    ``port`` 0 takes a free one. Raises ``RfedgeError`` naming host and port when they cannot be
    listened on, for example because another process does.
    """

    def __init__(self, registry: CollectorRegistry, host: str, port: int) -> None:
        try:
            self._server = _BoundedServer(host, port, registry)
        except OSError as error:
            raise RfedgeError(
                f"cannot serve metrics on {host}:{port}: {error.strerror or error}; "
                "give another --metrics-port, or 0 for a free one"
            ) from error
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving, and give the port back."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
