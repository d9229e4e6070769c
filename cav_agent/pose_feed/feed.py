"""A pose feed as the agent holds it: bytes go in on the event loop, checked fixes come out.

``FeedReader`` makes fixes of lines, whose format shows in how they begin. ``FeedChecks`` decides
which fixes are used and at what time of the agent's clock: it looks at their order, the feed's
clock, jumps and silence. ``PoseFeed`` joins them and keeps the fixes of a vehicle. All are state
machines: ``now_ns`` is an argument.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Lock

from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix
from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.nmea import NmeaParser

NS = 1_000_000_000
MAX_LINE_BYTES = 4096
"""NMEA allows 82, gpsd's reports take up to 1.5 KB."""
KEPT_FIXES = 2000
"""Fixes that are kept of a live feed: more than a minute at any rate of a receiver."""
MOST_RECORDED = 2_000_000
CLOCK_NS = 2 * NS
"""A feed's clock that differs by more from ours is another clock: its times are shifted."""
CLOCK_WINDOW = 20
"""The least delay of this many fixes is the difference of the clocks."""
ZONE_NS = 15 * 60 * NS
"""Time zones differ by multiples of a quarter of an hour."""
FASTEST_MPS = 80.0
"""More than any vehicle drives: 288 km/h."""
SIGMAS = 4.0
RESTARTED_AFTER = 3
"""This many fixes in order, but before the last used one, mean that the feed began again."""
SILENT_PERIODS = 3.0
LEAST_SILENT_NS = 2 * NS
QUIET_S = 30.0
EARTH_M = 6_371_000.0


class FeedReader:
    """Parses bytes as they come; ``refused`` is called for each line that cannot be used."""

    def __init__(self, refused: Callable[[BadReading], None]) -> None:
        self._refused = refused
        self._left = b""
        self._is_skipping = False
        self._json = JsonParser()
        self._nmea: NmeaParser | None = None

    def receive(self, data: bytes, now_ns: int) -> list[Fix]:
        """Return the fixes of the lines that ``data`` completes; never raises on content."""
        lines = (self._left + data).split(b"\n")
        self._left = lines.pop()
        if len(self._left) > MAX_LINE_BYTES:
            if not self._is_skipping:
                self._refused(_too_long())
            self._left, self._is_skipping = b"", True
        return list(self._fixes(lines, now_ns))

    def end(self, now_ns: int) -> list[Fix]:
        """Return the fix of a last line without an end; a datagram is complete, too."""
        return self.receive(b"\n", now_ns) if self._left.strip() else []

    def _fixes(self, lines: list[bytes], now_ns: int) -> Iterator[Fix]:
        for line in lines:
            if self._is_skipping:
                self._is_skipping = False
                continue
            try:
                fix = self._fix(line, now_ns)
            except BadReading as error:
                self._refused(error)
                continue
            if fix is not None:
                yield fix

    def _fix(self, line: bytes, now_ns: int) -> Fix | None:
        if len(line) > MAX_LINE_BYTES:
            raise _too_long()
        try:
            text = line.decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise BadReading(FeedProblem.MALFORMED, f"{line[:40]!r} is not ASCII") from error
        if not text or text.startswith("#"):
            return None
        if text[0] in "$!":
            if self._nmea is None:
                self._nmea = NmeaParser()
            return self._nmea.receive(text, now_ns)
        return self._json.receive(text)


def _too_long() -> BadReading:
    return BadReading(FeedProblem.MALFORMED, f"a line of more than {MAX_LINE_BYTES} bytes")


class ProblemLog:
    """Reports problems, and whether each begins: it is new, or was absent for ``QUIET_S``."""

    def __init__(self, report: Callable[[FeedProblem, str, bool], None]) -> None:
        self._report = report
        self._last_ns: dict[FeedProblem, int] = {}

    def note(self, problem: FeedProblem, text: str, now_ns: int) -> None:
        """Note a problem."""
        last_ns = self._last_ns.get(problem)
        self._last_ns[problem] = now_ns
        begins = last_ns is None or now_ns - last_ns > QUIET_S * NS
        self._report(problem, text, begins)


class FeedChecks:
    """Decides which fixes of one feed are used; ``recorded``: from a file, with its own clock."""

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
        """Add to the feed's times to get the agent's."""

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
        """Detect silence; to be called at least once a second."""
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
            text = f"{far_m:.1f} m in {seconds:.2f} s; the field shows whether it is true"
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


@dataclass(frozen=True)
class KeptFix:
    """A fix that is used, with its time on the agent's clock."""

    fix: Fix
    time_ns: int


class PoseFeed:
    """The fixes of one source; written by one thread, read by others.

    ``report`` is called with each problem, its text, and whether it begins. ``recorded``: the whole
    feed lies in a file, and its clock is that of the drive.
    """

    def __init__(
        self,
        report: Callable[[FeedProblem, str, bool], None],
        *,
        offset_s: float = 0.0,
        recorded: bool = False,
    ) -> None:
        self.recorded = recorded
        self.problems = ProblemLog(report)
        self._offset_ns = round(offset_s * NS)
        self._checks = FeedChecks(self.problems, recorded=recorded)
        self._reader = FeedReader(self._refused)
        self._lock = Lock()
        self._kept: deque[KeptFix] = deque(maxlen=MOST_RECORDED if recorded else KEPT_FIXES)
        self._now_ns = 0
        self.count = 0
        """Fixes used so far."""

    def receive(self, data: bytes, now_ns: int) -> int:
        """Take bytes as they came; return how many fixes of them are used."""
        self._now_ns = now_ns
        return self._take(self._reader.receive(data, now_ns), now_ns)

    def end(self, now_ns: int) -> None:
        """Take a last line without an end, when the source has ended."""
        self._take(self._reader.end(now_ns), now_ns)

    def idle(self, now_ns: int) -> None:
        """Detect silence, unless the feed is a file."""
        if not self.recorded:
            self._checks.idle(now_ns)

    def since(self, number: int) -> tuple[list[tuple[Fix, int]], int]:
        """Return (fix, time in ns) of the fixes after the first ``number``, and how many there are.

        Fixes that were so many ago that they are no longer kept are left out.
        """
        with self._lock:
            new = min(self.count - number, len(self._kept))
            kept = [self._kept[i] for i in range(len(self._kept) - new, len(self._kept))]
            return [(item.fix, item.time_ns) for item in kept], self.count

    def _take(self, fixes: list[Fix], now_ns: int) -> int:
        used = 0
        for fix in fixes:
            if self._checks.receive(fix, now_ns):
                time_ns = fix.time_ns + self._checks.shift_ns + self._offset_ns
                with self._lock:
                    self._kept.append(KeptFix(fix, max(time_ns, 0)))
                    self.count += 1
                used += 1
        return used

    def _refused(self, error: BadReading) -> None:
        self.problems.note(error.problem, str(error), self._now_ns)
