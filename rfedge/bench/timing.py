"""Medians of repeated calls on a monotonic clock."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter_ns

__all__ = ["REPETITIONS", "median_ms"]

REPETITIONS = 20
WARM_UP = 3


def median_ms(call: Callable[[], object], repetitions: int = REPETITIONS) -> float:
    """Return the median duration of ``call`` in milliseconds, after three calls to warm up."""
    for _ in range(WARM_UP):
        call()
    return median(_duration_ms(call) for _ in range(repetitions))


def _duration_ms(call: Callable[[], object]) -> float:
    start = perf_counter_ns()
    call()
    return (perf_counter_ns() - start) / 1e6
