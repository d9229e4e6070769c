"""What is wrong with a feed as it goes on: times, clock, jumps, silence.

A machine: ``now_ns`` is an argument. It decides which fixes are used and at what time of the
agent's clock, and keeps account of problems: each is told once when it begins, again when it
begins anew after ``QUIET_S`` without, and counted every time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from cav_agent.pose_feed.fix import FeedProblem, Fix

__all__ = ["FeedChecks", "ProblemLog", "distance_m"]

NS = 1_000_000_000
CLOCK_NS = 2 * NS
"""A feed's clock further from ours than this is another clock: its times are shifted."""
CLOCK_WINDOW = 20
"""Fixes whose least delay is the difference of the clocks."""
ZONE_NS = 15 * 60 * NS
"""Zones of the Earth differ by multiples of a quarter of an hour."""
FASTEST_MPS = 80.0
"""Faster than any vehicle this is for: 288 km/h."""
SIGMAS = 4.0
RESTARTED_AFTER = 3
"""So many fixes in order among themselves, but before the last used: the feed began again."""
SILENT_PERIODS = 3.0
LEAST_SILENT_NS = 2 * NS
QUIET_S = 30.0
EARTH_M = 6_371_000.0


class ProblemLog:
    """Counts problems, and says which are to be told."""

    def __init__(self, tell: Callable[[FeedProblem, str, bool], None]) -> None:
        self._tell = tell
        self._last_ns: dict[FeedProblem, int] = {}

    def note(self, problem: FeedProblem, text: str, now_ns: int) -> None:
        """Take note of a problem; ``tell`` hears whether it begins."""
        last_ns = self._last_ns.get(problem)
        self._last_ns[problem] = now_ns
        begins = last_ns is None or now_ns - last_ns > QUIET_S * NS
        self._tell(problem, text, begins)


class FeedChecks:
    """Decides about the fixes of one feed; ``recorded``: from a file, whose clock is its own."""

    def __init__(self, problems: ProblemLog, *, recorded: bool = False) -> None:
        self._problems = problems
        self._recorded = recorded
        self._last: Fix | None = None
        self._refused: list[Fix] = []
        self._delays_ns: deque[int] = deque(maxlen=CLOCK_WINDOW)
        self._used_at_ns: int | None = None
        self._period_ns = float(NS)
        self._is_silent = False
        self.shift_ns = 0
        """To add to the feed's times to get the agent's."""

    def receive(self, fix: Fix, now_ns: int) -> bool:
        """Return whether a fix is to be used."""
        if not self._is_newer(fix, now_ns):
            return False
        self._check_jump(fix, now_ns)
        if self._last is not None:
            step_ns = fix.time_ns - self._last.time_ns
            self._period_ns += 0.2 * (min(step_ns, 10 * NS) - self._period_ns)
        self._last, self._used_at_ns, self._is_silent = fix, now_ns, False
        if not self._recorded:
            self._compare_clocks(fix, now_ns)
        return True

    def idle(self, now_ns: int) -> None:
        """Notice silence; to be called now and then, at least once a second."""
        if self._used_at_ns is None:
            self._used_at_ns = now_ns
        silent_ns = now_ns - self._used_at_ns
        limit_ns = max(SILENT_PERIODS * self._period_ns, LEAST_SILENT_NS)
        if not self._is_silent and silent_ns > limit_ns:
            self._is_silent = True
            self._problems.note(FeedProblem.SILENT, f"no fix for {silent_ns / NS:.1f} s", now_ns)

    def _is_newer(self, fix: Fix, now_ns: int) -> bool:
        if self._last is None or fix.time_ns > self._last.time_ns:
            self._refused.clear()
            return True
        if fix.time_ns == self._last.time_ns:
            return False
        back_s = (self._last.time_ns - fix.time_ns) / NS
        text = f"a fix is {back_s:.3f} s older than the one before"
        self._problems.note(FeedProblem.BACKWARDS, text, now_ns)
        in_order = not self._refused or fix.time_ns > self._refused[-1].time_ns
        self._refused = [*self._refused, fix] if in_order else [fix]
        if len(self._refused) < RESTARTED_AFTER:
            return False
        self._refused.clear()
        self._delays_ns.clear()
        self._last = None
        return True

    def _check_jump(self, fix: Fix, now_ns: int) -> None:
        last = self._last
        if last is None or (fix.xyz_m is None) != (last.xyz_m is None):
            return
        seconds = (fix.time_ns - last.time_ns) / NS
        far_m = distance_m(last, fix)
        spread_m = math.hypot(*fix.position_std_m[:2], *last.position_std_m[:2])
        if far_m > FASTEST_MPS * seconds + SIGMAS * spread_m:
            text = f"{far_m:.1f} m in {seconds:.2f} s; the field will tell whether it is so"
            self._problems.note(FeedProblem.JUMP, text, now_ns)

    def _compare_clocks(self, fix: Fix, now_ns: int) -> None:
        """Shift the feed's times by the least delay seen, where the clocks differ."""
        self._delays_ns.append(now_ns - fix.time_ns)
        least_ns = min(self._delays_ns)
        if abs(least_ns) <= CLOCK_NS:
            self.shift_ns = 0
            return
        if abs(least_ns - self.shift_ns) > CLOCK_NS:
            self._problems.note(FeedProblem.CLOCK, _difference_text(least_ns), now_ns)
        self.shift_ns = least_ns


def _difference_text(delay_ns: int) -> str:
    zones = round(delay_ns / ZONE_NS)
    side = "behind" if delay_ns > 0 else "ahead of"
    text = f"the feed's clock is {abs(delay_ns) / NS:.1f} s {side} ours"
    if zones and abs(delay_ns - zones * ZONE_NS) <= CLOCK_NS:
        text += f", the time zone of UTC{-zones * 0.25:+g} h: set it to UTC"
    return f"{text}; its times are shifted by that"


def distance_m(a: Fix, b: Fix) -> float:
    """Return how far apart two fixes are on the ground, to a hundredth: a sphere's arcs."""
    if a.xyz_m is not None and b.xyz_m is not None:
        return math.dist(a.xyz_m, b.xyz_m)
    assert a.geodetic is not None
    assert b.geodetic is not None
    (lat_a, lon_a, _), (lat_b, lon_b, _) = a.geodetic, b.geodetic
    turn_deg = (lon_b - lon_a + 180.0) % 360.0 - 180.0
    east = math.radians(turn_deg) * math.cos(math.radians(0.5 * (lat_a + lat_b)))
    return EARTH_M * math.hypot(east, math.radians(lat_b - lat_a))
