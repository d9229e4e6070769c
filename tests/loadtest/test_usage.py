"""Use of processes: samples with an answer by algebra, and this very process."""

import threading

import psutil
import pytest

from rfedge.loadtest.drive import Sample, Usage, sample


def samples_of(rss_mb: list[float]) -> list[Sample]:
    """One sample every half second: half a core, a fifth of it on the loop."""
    return [Sample(0.5 * i, 0.25 * i, 0.05 * i, mb, 10, 4, 0) for i, mb in enumerate(rss_mb)]


def test_cpu_is_seconds_per_second():
    usage = Usage(samples_of([1.0] * 9))
    assert usage.cores == pytest.approx(0.5)
    assert usage.loop_cores == pytest.approx(0.1)


def test_a_steady_climb_is_growth_over_the_whole():
    """2 MB a sample over 120 samples: 240 MB in a minute."""
    climbing = samples_of([100.0 + 2.0 * i for i in range(120)])
    assert Usage(climbing).growth_mb == pytest.approx(240.0)


def test_flat_memory_does_not_grow():
    flat = samples_of([100.0, 101.0] * 60)
    assert Usage(flat).growth_mb == 0.0


def test_this_process_is_seen_with_its_threads():
    before = sample(psutil.Process())
    stop = threading.Event()
    thread = threading.Thread(target=stop.wait)
    thread.start()
    try:
        after = sample(psutil.Process())
    finally:
        stop.set()
        thread.join()
    assert after.threads == before.threads + 1
    assert after.rss_mb > 1.0
    assert after.cpu_s >= before.cpu_s >= before.loop_cpu_s >= 0.0
