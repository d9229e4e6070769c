"""A recorded capacity, in Mahimahi's format (Netravali et al., USENIX ATC 2015).

One integer a line, milliseconds since the trace began, ascending: an opportunity to deliver 1500
bytes. Repeated numbers are as many opportunities. After the last line the trace begins again, at
the last line's time. Bytes share an opportunity if they wait for it, and fill as many as they need;
an opportunity that nobody waits for is lost.

In a profile: ``[uplink.trace]`` with ``file``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

from rfcore.errors import InvalidData
from rfcore.link.plan import Parts
from rfcore.tables import Table

__all__ = ["OPPORTUNITY_BYTES", "Trace", "TraceTransmission", "parse", "read_mahimahi"]

OPPORTUNITY_BYTES = 1500

MAX_OPPORTUNITIES = 10_000_000
"""Ten Gbit/s for ten seconds; more is not a recording of a radio link."""


@dataclass(frozen=True)
class Trace:
    """Opportunities at ``times_ms``, ascending, repeated every ``times_ms[-1]`` ms.

    Raises ``InvalidData`` for times that cannot be a trace.
    """

    times_ms: Sequence[int]
    name: str = "trace"

    def __post_init__(self) -> None:
        if not 0 < len(self.times_ms) <= MAX_OPPORTUNITIES:
            raise InvalidData(
                f"{len(self.times_ms)} delivery opportunities, expected 1..{MAX_OPPORTUNITIES}"
            )
        previous = 0
        for line, time_ms in enumerate(self.times_ms, start=1):
            if time_ms < previous:
                raise InvalidData(f"line {line}: {time_ms} ms comes after {previous} ms; sort it")
            previous = time_ms
        if previous == 0:
            raise InvalidData("every opportunity is at 0 ms; a trace has to last some time")

    @property
    def period_s(self) -> float:
        """Seconds until the trace begins again."""
        return self.times_ms[-1] / 1e3

    @property
    def mean_rate_bps(self) -> float:
        """Capacity over a whole period, bits per second."""
        return len(self.times_ms) * OPPORTUNITY_BYTES * 8 / self.period_s

    def apply(self, parts: Parts, random: Random) -> Parts:  # noqa: ARG002
        """Transmit by this trace, whatever the rate was."""
        return Parts(TraceTransmission(self), parts.delays)


class TraceTransmission:
    """Gives bytes the opportunities of ``trace``, first come first served."""

    def __init__(self, trace: Trace) -> None:
        self._times_ms = trace.times_ms
        self._period_ms = trace.times_ms[-1]
        self._index = 0
        self._left_bytes = OPPORTUNITY_BYTES
        self._busy_until_s = float("-inf")

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Return start and end of transmission."""
        start_s = max(at_s, self._busy_until_s)
        if size_bytes == 0:
            return start_s, start_s
        first = self._first_not_before(start_s)
        if first > self._index:
            self._index, self._left_bytes = first, OPPORTUNITY_BYTES
        more = -(-(size_bytes - self._left_bytes) // OPPORTUNITY_BYTES)
        if more > 0:
            self._index += more
            self._left_bytes += more * OPPORTUNITY_BYTES
        self._left_bytes -= size_bytes
        self._busy_until_s = max(start_s, self._time_s(self._index))
        return start_s, self._busy_until_s

    def _first_not_before(self, at_s: float) -> int:
        """Return the number of the first opportunity at or after ``at_s``, wraps counted."""
        at_ms = max(0.0, at_s * 1e3)
        round_ = max(0, int(at_ms // self._period_ms) - 1)
        while True:
            index = bisect_left(self._times_ms, at_ms - round_ * self._period_ms)
            if index < len(self._times_ms):
                return self._not_early(round_ * len(self._times_ms) + index, at_s)
            round_ += 1

    def _not_early(self, index: int, at_s: float) -> int:
        """Undo the rounding of milliseconds: the opportunity taken must not be in the past."""
        while index > 0 and self._time_s(index - 1) >= at_s:
            index -= 1
        while self._time_s(index) < at_s:
            index += 1
        return index

    def _time_s(self, index: int) -> float:
        round_, within = divmod(index, len(self._times_ms))
        return (round_ * self._period_ms + self._times_ms[within]) / 1e3


def read_mahimahi(path: Path) -> Trace:
    """Read a trace; raise ``InvalidData`` naming the line that is wrong."""
    times_ms: list[int] = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        text = line.strip()
        if text.startswith(b"#") or not text:
            continue
        if not text.isdigit() or len(text) > 12:
            raise InvalidData(
                f"{path}: line {number}: {text[:40].decode('latin-1')!a} must be a whole "
                "number of milliseconds"
            )
        times_ms.append(int(text))
    try:
        return Trace(tuple(times_ms))
    except InvalidData as error:
        raise InvalidData(f"{path}: {error}") from error


def parse(table: Table, folder: Path) -> Trace:
    """Return the impairment of a profile's table; its file is looked for in ``folder``."""
    trace = read_mahimahi(folder / table.text("file"))
    table.finish()
    return trace
