"""The metrics' port takes few threads, and none for long."""

import socket
import threading
import time
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client import CollectorRegistry, Counter

from rfcore.wire import instruments
from rfcore.wire.instruments import MAX_SCRAPES, MetricsEndpoint


@pytest.fixture
def endpoint(monkeypatch: pytest.MonkeyPatch) -> Iterator[MetricsEndpoint]:
    monkeypatch.setattr(instruments, "SCRAPE_S", 0.3)
    registry = CollectorRegistry()
    Counter("calls", "Calls.", registry=registry).inc(3)
    endpoint = MetricsEndpoint(registry, "127.0.0.1", 0)
    yield endpoint
    endpoint.close()


def scrape(endpoint: MetricsEndpoint) -> str:
    url = f"http://127.0.0.1:{endpoint.port}/metrics"
    with urllib.request.urlopen(url, timeout=10) as answer:
        return str(answer.read().decode())


def test_half_requests_take_few_threads_and_are_cut(endpoint: MetricsEndpoint) -> None:
    before = threading.active_count()
    halves = [socket.create_connection(("127.0.0.1", endpoint.port), 10) for _ in range(60)]
    for half in halves:
        half.send(b"GET /metrics HTTP/1.1\r\nX-")
    until_s = time.monotonic() + 20
    most = 0
    left = set(halves)
    while left:
        most = max(most, threading.active_count() - before)
        assert time.monotonic() < until_s
        for half in tuple(left):
            half.settimeout(0.02)
            try:
                if half.recv(1) == b"":
                    left.discard(half)
                    half.close()
            except TimeoutError:
                pass
            except ConnectionResetError:
                left.discard(half)
                half.close()
    assert 0 < most <= MAX_SCRAPES
    assert "calls_total" in scrape(endpoint)
