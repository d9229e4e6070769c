"""The largest number of vehicles that holds: double until it breaks, then halve the interval."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["largest_held"]

CLOSE = 1.1
"""Runs are short and machines noisy: within a tenth is as near as a repetition comes."""


def largest_held(first: int, held: Callable[[int], bool], most: int = 1000) -> int:
    """Return the largest count for which ``held`` was true, 0 if it is for none up to ``first``.

    ``held`` is asked once for each count. Found exactly below ten, and within a tenth above.
    """
    low, high = 0, first
    while high <= most and held(high):
        low, high = high, 2 * high
    high = min(high, most + 1)
    while high - low > 1 and high > CLOSE * low:
        middle = (low + high) // 2
        low, high = (middle, high) if held(middle) else (low, middle)
    return low
