"""Metrics follow the conventions, and their port takes few threads."""

import re
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client import CollectorRegistry, Counter, generate_latest

from lab.pages.metrics import families
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.raster.renderers import DeviceRecord
from rfcore.wire import instruments
from rfcore.wire.conventions import FRAME_BUDGET_BUCKETS_S
from rfcore.wire.instruments import MAX_SCRAPES, Instruments, MetricsEndpoint

DECLARED = {family.name: family for listed in families().values() for family in listed}


@pytest.mark.parametrize("name", sorted(DECLARED))
def test_a_name_says_its_unit_and_kind(name: str) -> None:
    family = DECLARED[name]
    assert name.endswith("_total") == (family.kind == "counter")
    assert name.endswith("_info") == ("1; " in family.text or "1 for each" in family.text)
    assert not re.search(r"_(ms|ns|milliseconds|kb|mb|bits)(_|$)", name)


def test_what_is_declared_is_what_is_served() -> None:
    """Declared names are ours; served ones are the client library's: its endings included."""
    registry = CollectorRegistry()
    make = Instruments(registry)
    make.process()
    make.counter("rfedge_x_bytes", "Bytes.").inc(3)
    make.gauge("rfedge_y", "Things.").set(2)
    make.seconds("rfedge_z_seconds", "Time.").observe(0.004)
    served = generate_latest(registry).decode()
    helped = set(re.findall(r"^# HELP (\w+)", served, re.M))
    assert {family.name for family in make.families} == {
        name for name in helped if not name.endswith("_created")
    }
    assert "rfedge_x_bytes_total 3.0" in served
    assert 'rfedge_z_seconds_bucket{le="0.005"} 1.0' in served


def test_buckets_hold_the_frame_budgets() -> None:
    for rate_hz in (200, 100, 60, 30, 20, 10, 5):
        nearest = min(FRAME_BUDGET_BUCKETS_S, key=lambda b: abs(b - 1 / rate_hz))
        assert nearest == pytest.approx(1 / rate_hz, rel=0.01)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("other_seconds", "Time.", "must begin with rfedge_"),
        ("rfedge_x_seconds", "Time", "must be a sentence"),
        ("rfedge_x_ms", "Time.", "end it in _seconds"),
    ],
)
def test_a_name_against_the_conventions_is_refused(name: str, text: str, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem):
        Instruments(CollectorRegistry()).seconds(name, text)


def served(registry: CollectorRegistry) -> list[str]:
    """Return what a scrape sees, without the times of creation."""
    return [x for x in generate_latest(registry).decode().splitlines() if "_created" not in x]


def test_an_observation_at_a_bound_is_in_its_bucket_and_one_beyond_all_in_the_last() -> None:
    registry = CollectorRegistry()
    histogram = Instruments(registry).seconds("rfedge_x_seconds", "Time.")
    for seconds in (FRAME_BUDGET_BUCKETS_S[0], 1e6):
        histogram.observe(seconds)
    lines = served(registry)
    assert f'rfedge_x_seconds_bucket{{le="{FRAME_BUDGET_BUCKETS_S[0]}"}} 1.0' in lines
    assert f'rfedge_x_seconds_bucket{{le="{FRAME_BUDGET_BUCKETS_S[-1]}"}} 1.0' in lines
    assert 'rfedge_x_seconds_bucket{le="+Inf"} 2.0' in lines
    assert "rfedge_x_seconds_count 2.0" in lines


def test_an_endpoint_serves_until_it_is_closed_and_names_a_port_in_use() -> None:
    registry = CollectorRegistry()
    Instruments(registry).gauge("rfedge_y", "Things.").set(2)
    endpoint = MetricsEndpoint(registry, "127.0.0.1", 0)
    with urllib.request.urlopen(f"http://127.0.0.1:{endpoint.port}/metrics") as response:
        assert b"rfedge_y 2.0" in response.read()
    problem = (
        f"cannot serve metrics on 127.0.0.1:{endpoint.port}: Address already in use; "
        "give another --metrics-port, or 0 for a free one"
    )
    with pytest.raises(RfedgeError, match=f"^{re.escape(problem)}$"):
        MetricsEndpoint(registry, "127.0.0.1", endpoint.port)
    endpoint.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", endpoint.port))


def test_a_host_that_is_not_ours_is_named_too() -> None:
    with pytest.raises(RfedgeError, match=r"cannot serve metrics on 192\.0\.2\.1:0: Cannot assign"):
        MetricsEndpoint(CollectorRegistry(), "192.0.2.1", 0)


def test_devices_and_what_the_cpu_drew_for_them_are_served() -> None:
    registry, record = CollectorRegistry(), DeviceRecord()
    Instruments(registry).devices(record)
    for _ in range(2):
        record.add_opened("GPU", "Platform 1, driver 2", "plain")
    record.add_lost()
    assert generate_latest(registry).count(b"rfedge_opencl_device_info{") == 1
    labels = {"device": "GPU", "driver": "Platform 1, driver 2", "build": "plain"}
    assert registry.get_sample_value("rfedge_opencl_device_info", labels) == 1
    fallbacks = "rfedge_opencl_fallbacks_total"
    assert registry.get_sample_value(fallbacks, {"reason": "lost"}) == 1
    assert registry.get_sample_value(fallbacks, {"reason": "full"}) == 0


# --- the metrics' port takes few threads, and none for long


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
