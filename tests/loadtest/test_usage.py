"""Use of processes: samples with an answer by algebra, and this very process."""

import threading

import psutil
import pytest

from rfedge.loadtest.drive import RunMeasurements, Sample, Usage, measured, sample
from rfedge.loadtest.plan import (
    SETTLING_S,
    Bounds,
    Load,
    Measured,
    Mode,
    VehicleReport,
    judge,
)


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


@pytest.mark.parametrize("warm_up_s", [0.0, 4.0, 10.0, 30.0])
def test_memory_that_a_server_fills_as_it_settles_does_not_count(warm_up_s):
    """It takes 80 MB in the first 10 s of pictures, and from then on nothing, or 1 MB a second."""
    seconds = [warm_up_s + 0.5 * k for k in range(61)]
    for later_mb in (0.0, 1.0):
        rss_mb = [8 * min(s, SETTLING_S) + later_mb * max(0.0, s - SETTLING_S) for s in seconds]
        found = measured_of(rss_mb, warm_up_s)
        assert found.growth_mb == pytest.approx(later_mb * 60 * found.minutes, abs=1.0)
        assert 60 * found.minutes == pytest.approx(30 - max(0.0, SETTLING_S - warm_up_s))


def test_memory_of_a_run_that_ends_before_it_has_settled_is_not_judged():
    found = measured_of([10.0 * k for k in range(15)], warm_up_s=2.0)
    assert found.growth_mb is None
    assert not any("memory" in problem for problem in judge(found, Bounds()).broken)


def measured_of(rss_mb: list[float], warm_up_s: float) -> Measured:
    load = Load(Mode.FULL, 1, 10.0, duration_s=len(rss_mb) / 2, warm_up_s=warm_up_s)
    usage = {"server": Usage(samples_of(rss_mb))}
    run = RunMeasurements([VehicleReport(1, [5.0])], 0.0, usage, 0.1, 10.0)
    return measured(load, run, 0.0, workers=1)


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
