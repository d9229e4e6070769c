"""A feed as the agent holds it: bytes go in on the event loop, measured poses come out per field.

``PoseFeed`` is one for the vehicle; its fixes are on the Earth or in the drives' global frame.
``FieldFeed`` reads them for one field: placed by its anchor, inside its bounds, each once. The two
may be used by different threads. ``FeedReader`` makes fixes of bytes: of lines, whose format shows
in how they begin.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Lock

from cav_agent.pose_feed.checks import NS, FeedChecks, ProblemLog
from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix
from cav_agent.pose_feed.json_lines import JsonParser
from cav_agent.pose_feed.nmea import NmeaParser
from cav_agent.pose_feed.placing import Place
from cav_agent.pose_feed.time_offset import TimeOffset, TimeOffsetEstimator
from rfcore.camera import Vec3
from rfcore.errors import InvalidInput
from rfcore.field import Bounds
from rfcore.localise.measurement import PoseMeasurement

__all__ = ["FeedReader", "FieldFeed", "PoseFeed"]

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
