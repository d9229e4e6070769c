"""How many vehicles an uplink carries, from what one of them sends.

Vehicles of a cell share its throughput. Each sends the drive's packets at its rate, at moments
spread over a period; a packet that is transmitted later than the budget is late. The caller takes
the rest of the deadline (server, way back, encoding) off the budget.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rfcore.link import LinkProfile
from rfcore.link.plan import Arrival, delivery_times

__all__ = [
    "CLOSE",
    "MOST",
    "RATES_MBPS",
    "Traffic",
    "largest_held",
    "on_time_share",
    "vehicles_carried",
]

CLOSE = 1.1
"""Ratio of bounds at which the search stops: short runs on a noisy machine repeat no closer."""


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


RATES_MBPS = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 32.0, 64.0, 128.0)
MOST = 64
PERIODS = 50


@dataclass(frozen=True)
class Traffic:
    """What one vehicle sends, ``hz`` packets a second of ``sizes_bytes`` in turn, and the share of
    them that must be through within ``budget_s``."""

    sizes_bytes: Sequence[int]
    hz: float
    budget_s: float
    share: float = 0.99


def vehicles_carried(traffic: Traffic, rate_bps: float) -> int:
    """Return how many vehicles an uplink of ``rate_bps`` carries, at most 64."""

    def held(vehicles: int) -> bool:
        return on_time_share(traffic, rate_bps, vehicles) >= traffic.share

    return largest_held(1, held, MOST)


def on_time_share(traffic: Traffic, rate_bps: float, vehicles: int) -> float:
    """Return the share of packets that are through within the budget."""
    sizes, period_s = traffic.sizes_bytes, 1.0 / traffic.hz
    schedule = [
        Arrival((n + v / vehicles) * period_s, sizes[(n + v) % len(sizes)])
        for n in range(PERIODS)
        for v in range(vehicles)
    ]
    due_s = delivery_times(LinkProfile(rate_bps), schedule)
    in_time = (
        done_s - sent.at_s <= traffic.budget_s for sent, done_s in zip(schedule, due_s, strict=True)
    )
    return sum(in_time) / len(schedule)
