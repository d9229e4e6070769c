"""A feed as the agent holds it: bytes go in on the event loop, measured poses come out per field.

``PoseFeed`` is one for the vehicle; its fixes are on the Earth or in the drives' global frame.
``FieldFeed`` reads them for one field: placed by its anchor, inside its bounds, each once. The two
may be used by different threads. ``FeedReader`` makes fixes of bytes: of lines, whose format shows
in how they begin.

``TimeOffset`` tells how late a feed's times are against the camera's, from the poses the field
gave. A fix stamped t that was the vehicle's position at t + tau lies off the true path by about
velocity * tau; a bias adds the same everywhere. Over fixes with errors e and velocities v,

    e = bias + v tau + noise,

the least-squares tau is sum (v - mean v)(e - mean e) / sum |v - mean v|^2: it is known as far as
the velocity has changed, in size or direction. A machine; old fixes are forgotten.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Lock

import numpy as np

from cav_agent.pose_feed.checks import NS, FeedChecks, ProblemLog
from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix
from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.nmea import NmeaParser
from cav_agent.pose_feed.placing import Place
from rfcore.camera import Vec3
from rfcore.errors import InvalidInput
from rfcore.field import Bounds
from rfcore.localise.prior import PoseMeasurement

__all__ = ["FeedReader", "FieldFeed", "PoseFeed", "TimeOffset", "TimeOffsetEstimator"]

KEPT = 300
FEWEST = 8
DETERMINED_S = 0.1
"""A larger standard deviation says nothing."""
LONGEST_GAP_S = 1.0
"""Between poses of the field that a fix is compared with."""


@dataclass(frozen=True)
class TimeOffset:
    """Add ``seconds`` to a feed's times to get the camera's; one sigma ``std_s``."""

    seconds: float
    std_s: float


class TimeOffsetEstimator:
    """Collects where the camera was and what the feed said of that."""

    def __init__(self) -> None:
        self._path: deque[tuple[float, Vec3]] = deque(maxlen=KEPT)
        self._pairs: deque[tuple[Vec3, Vec3]] = deque(maxlen=KEPT)
        self._waiting: deque[tuple[float, Vec3]] = deque(maxlen=KEPT)

    def localised(self, time_s: float, position_m: Vec3) -> None:
        """Take a position the field gave; raise ``InvalidInput`` for time that goes back."""
        if self._path and time_s <= self._path[-1][0]:
            raise InvalidInput("time_s", f"{time_s} is not after {self._path[-1][0]}")
        self._path.append((time_s, position_m))
        while self._waiting and self._waiting[0][0] <= time_s:
            self._compare(*self._waiting.popleft())

    def measured(self, time_s: float, position_m: Vec3) -> None:
        """Take a position the feed gave, compared as soon as the path has come so far."""
        self._waiting.append((time_s, position_m))

    def offset(self) -> TimeOffset | None:
        """Return the offset, None while the drive does not determine it to 0.1 s."""
        if len(self._pairs) < FEWEST:
            return None
        pairs = np.array(self._pairs)
        errors, velocities = pairs[:, 0], pairs[:, 1]
        errors, velocities = errors - errors.mean(axis=0), velocities - velocities.mean(axis=0)
        change = float((velocities**2).sum())
        if change <= 0.0:
            return None
        seconds = float((velocities * errors).sum()) / change
        noise = float(((errors - seconds * velocities) ** 2).sum())
        std_s = math.sqrt(noise / (3 * len(pairs) - 4) / change)
        return TimeOffset(seconds, std_s) if std_s <= DETERMINED_S else None

    def _compare(self, time_s: float, position_m: Vec3) -> None:
        times = [at_s for at_s, _ in self._path]
        after = bisect_right(times, time_s)
        after = after - 1 if after == len(times) and times[-1] == time_s else after
        if not 0 < after < len(times) or times[after] - times[after - 1] > LONGEST_GAP_S:
            return
        (begin_s, a), (end_s, b) = self._path[after - 1], self._path[after]
        share = (time_s - begin_s) / (end_s - begin_s)
        velocity = [(q - p) / (end_s - begin_s) for p, q in zip(a, b, strict=True)]
        error = [z - p - share * (q - p) for z, p, q in zip(position_m, a, b, strict=True)]
        self._pairs.append(
            ((error[0], error[1], error[2]), (velocity[0], velocity[1], velocity[2]))
        )


MAX_LINE_BYTES = 4096
"""NMEA allows 82, gpsd's reports take up to 1.5 KB."""


class FeedReader:
    """Takes bytes as they come; ``refused`` hears of each line that cannot be used."""

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


KEPT_FIXES = 2000
"""Of a live feed: more than a minute at any rate of a receiver."""
MOST_RECORDED = 2_000_000
MARGIN_M = 50.0
SIGMAS = 4.0
"""A position is outside a field's bounds if it is that far beyond them."""


@dataclass(frozen=True)
class _Kept:
    """A fix that is used, at its time of the agent's clock."""

    fix: Fix
    time_ns: int


class PoseFeed:
    """The fixes of one source. ``tell`` hears of problems: which, in words, and if it begins.

    ``recorded``: the whole feed lies in a file, and its clock is that of the drive.
    """

    def __init__(
        self,
        tell: Callable[[FeedProblem, str, bool], None],
        *,
        offset_s: float = 0.0,
        recorded: bool = False,
    ) -> None:
        self.recorded = recorded
        self.problems = ProblemLog(tell)
        self._offset_ns = round(offset_s * NS)
        self._checks = FeedChecks(self.problems, recorded=recorded)
        self._reader = FeedReader(self._refused)
        self._lock = Lock()
        self._kept: deque[_Kept] = deque(maxlen=MOST_RECORDED if recorded else KEPT_FIXES)
        self._now_ns = 0
        self.count = 0
        """Fixes used so far."""

    def receive(self, data: bytes, now_ns: int) -> int:
        """Take bytes as they came; return how many fixes of them are used."""
        self._now_ns = now_ns
        return self._take(self._reader.receive(data, now_ns), now_ns)

    def end(self, now_ns: int) -> None:
        """The source has ended: a last line may lack its end."""
        self._take(self._reader.end(now_ns), now_ns)

    def idle(self, now_ns: int) -> None:
        """Notice silence, unless the feed is a file."""
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
                    self._kept.append(_Kept(fix, max(time_ns, 0)))
                    self.count += 1
                used += 1
        return used

    def _refused(self, error: BadReading) -> None:
        self.problems.note(error.problem, str(error), self._now_ns)


class FieldFeed:
    """What a feed says of the camera in one field; ``bounds`` None: anywhere."""

    def __init__(self, feed: PoseFeed, place: Place, bounds: Bounds | None = None) -> None:
        self._feed, self._place, self._bounds = feed, place, bounds
        self._number = 0
        self._waiting: deque[tuple[Fix, int]] = deque()
        self._estimator = TimeOffsetEstimator()

    def measurements(self, until_ns: int) -> list[PoseMeasurement]:
        """Return the poses measured up to a time of the camera's clock, each once, in order.

        None of them: the feed has said nothing new.
        """
        new, self._number = self._feed.since(self._number)
        self._waiting.extend(new)
        found = []
        while self._waiting and self._waiting[0][1] <= until_ns:
            measurement = self._measurement(*self._waiting.popleft())
            if measurement is not None:
                found.append(measurement)
        return found

    def restart(self) -> None:
        """Begin again with the first fix that is kept: of a recorded feed, with the drive."""
        self._number = 0
        self._waiting.clear()

    def localised(self, time_ns: int, position_m: Vec3) -> None:
        """Take where the field says that the camera was: it tells how late the feed is."""
        try:
            self._estimator.localised(time_ns / NS, position_m)
        except InvalidInput:
            self._estimator = TimeOffsetEstimator()  # a drive begins again

    def time_offset(self) -> TimeOffset | None:
        """Return what to add to the feed's times, None where the drive does not tell."""
        return self._estimator.offset()

    def _measurement(self, fix: Fix, time_ns: int) -> PoseMeasurement | None:
        try:
            measurement = self._place.measurement(fix, time_ns)
        except InvalidInput as error:
            no_anchor = fix.geodetic is not None and self._place.anchor is None
            problem = FeedProblem.NO_ANCHOR if no_anchor else FeedProblem.NOT_FINITE
            self._feed.problems.note(problem, str(error), time_ns)
            return None
        if not self._is_inside(measurement):
            where = ", ".join(f"{value:.0f}" for value in measurement.position_m)
            text = f"({where}) m is beyond the field's bounds"
            self._feed.problems.note(FeedProblem.OUTSIDE, text, time_ns)
            return None
        self._estimator.measured(time_ns / NS, measurement.position_m)
        return measurement

    def _is_inside(self, measurement: PoseMeasurement) -> bool:
        if self._bounds is None:
            return True
        corners = zip(self._bounds.low_m, self._bounds.high_m, strict=True)
        axes = zip(measurement.position_m, measurement.position_std_m, corners, strict=True)
        return all(
            low - MARGIN_M - SIGMAS * std <= at <= high + MARGIN_M + SIGMAS * std
            for at, std, (low, high) in axes
        )
