"""Median durations of repeated calls, on a monotonic clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import median
from time import perf_counter_ns

REPETITIONS = 20
WARM_UP = 3


def median_ms(call: Callable[[], object], repetitions: int = REPETITIONS) -> float:
    """Return the median duration of ``call`` in milliseconds, after three calls to warm up."""
    for _ in range(WARM_UP):
        call()
    return median(_duration_ms(call) for _ in range(repetitions))


def medians_ms(
    calls: Mapping[str, Callable[[], object]], repetitions: int = REPETITIONS
) -> dict[str, float]:
    """Return the median duration of each call; they take turns, after one round to warm up."""
    durations: dict[str, list[float]] = {name: [] for name in calls}
    for round_number in range(repetitions + 1):
        for name, call in calls.items():
            duration_ms = _duration_ms(call)
            if round_number > 0:
                durations[name].append(duration_ms)
    return {name: median(values) for name, values in durations.items()}


def _duration_ms(call: Callable[[], object]) -> float:
    start = perf_counter_ns()
    call()
    return (perf_counter_ns() - start) / 1e6
