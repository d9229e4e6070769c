"""Impairments of a link that were recorded: its capacity and its delay.

*Capacity*, in Mahimahi's format (Netravali et al., USENIX ATC 2015): one integer a line,
milliseconds since the trace began, ascending, stands for an opportunity to deliver 1500 bytes.
Repeated numbers are as many opportunities. After the last line the trace begins again, at the last
line's time. Bytes share an opportunity if they wait for it, and fill as many as they need; an
opportunity that nobody waits for is lost. In a profile: ``[uplink.trace]`` with ``file``.

*Delay*, in the format of the CICV5G recordings (doi:10.5281/zenodo.17475688): a header line, then
columns parted by blanks: time of sending and of receiving in ms, delay in ms, and what else was
recorded. The delay was taken from vehicle to network to vehicle, so a direction gets a ``share`` of
it, one half unless said otherwise. It holds until the next sample; after the last one the recording
begins again. In a profile: ``[uplink.delay_trace]`` with ``file`` and ``share``; it adds to
``delay_ms``.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from rfcore.errors import InvalidData
from rfcore.link.shaper import MAX_DELAY_S, LinkParts
from rfcore.tables import Range, Table

OPPORTUNITY_BYTES = 1500

DELAY_COLUMNS = ("pub_time(ms)", "sub_time(ms)", "delay(ms)")
MAX_OPPORTUNITIES = 10_000_000
"""Ten Gbit/s for ten seconds; more is not a recording of a radio link."""


@dataclass(frozen=True)
class CapacityTrace:
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

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:  # noqa: ARG002
        """Transmit by this trace, whatever the rate was."""
        return replace(parts, transmission=TraceTransmission(self))


class TraceTransmission:
    """Gives bytes the opportunities of ``trace``, first come first served."""

    def __init__(self, trace: CapacityTrace) -> None:
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


def read_mahimahi(path: Path) -> CapacityTrace:
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
        return CapacityTrace(tuple(times_ms))
    except InvalidData as error:
        raise InvalidData(f"{path}: {error}") from error


@dataclass(frozen=True)
class DelayTrace:
    """The delay is ``delays_s[i]`` from ``times_s[i]`` on; ``times_s`` begins at 0 and ascends.

    Raises ``InvalidData`` for samples that cannot be a recording.
    """

    times_s: Sequence[float]
    delays_s: Sequence[float]
    name: str = "delay_trace"

    def __post_init__(self) -> None:
        if len(self.times_s) != len(self.delays_s) or len(self.times_s) < 2:
            raise InvalidData(f"{len(self.times_s)} samples of delay, expected 2 or more")
        if self.times_s[0] != 0.0 or any(
            not a <= b for a, b in zip(self.times_s, self.times_s[1:], strict=False)
        ):
            raise InvalidData("the times of a delay trace must begin at 0 and ascend")
        if self.times_s[-1] <= 0.0:
            raise InvalidData("every sample is at 0 s; a recording has to last some time")
        for delay_s in self.delays_s:
            if not 0.0 <= delay_s <= MAX_DELAY_S:
                raise InvalidData(f"a delay of {delay_s} s is outside 0..{MAX_DELAY_S:g} s")

    @property
    def period_s(self) -> float:
        """Seconds until the recording begins again: its length and one mean interval."""
        return self.times_s[-1] * len(self.times_s) / (len(self.times_s) - 1)

    def delay_s(self, at_s: float) -> float:
        """Return the delay at ``at_s`` seconds after the beginning."""
        index = bisect_right(self.times_s, math.fmod(max(0.0, at_s), self.period_s)) - 1
        return self.delays_s[index]

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:  # noqa: ARG002
        """Add this delay."""
        return parts.with_delay(self.delay_s)


def read_cicv5g(path: Path, share: float = 0.5) -> DelayTrace:
    """Read a recording; raise ``InvalidData`` naming the line that is wrong."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or tuple(lines[0].split()[:3]) != DELAY_COLUMNS:
        raise InvalidData(f"{path}: line 1 must begin with {' '.join(DELAY_COLUMNS)}")
    samples = [
        _delay_sample(path, number, line) for number, line in enumerate(lines[1:], start=2) if line
    ]
    begin_ms = samples[0][0] if samples else 0.0
    try:
        return DelayTrace(
            tuple((sent_ms - begin_ms) / 1e3 for sent_ms, _ in samples),
            tuple(share * delay_ms / 1e3 for _, delay_ms in samples),
        )
    except InvalidData as error:
        raise InvalidData(f"{path}: {error}") from error


def _delay_sample(path: Path, number: int, line: str) -> tuple[float, float]:
    try:
        sent, _, delay = (float(word) for word in line.split()[:3])
    except ValueError as error:
        raise InvalidData(f"{path}: line {number} has no three numbers in front") from error
    if not (math.isfinite(sent) and math.isfinite(delay)):
        raise InvalidData(f"{path}: line {number}: {line[:40]!r} is not finite")
    return sent, delay


def parse_recording(name: str, table: Table, folder: Path) -> CapacityTrace | DelayTrace:
    """Return what a profile's table of that name declares; its file is looked for in ``folder``."""
    path = folder / table.text("file")
    recording: CapacityTrace | DelayTrace
    if name == "trace":
        recording = read_mahimahi(path)
    else:
        recording = read_cicv5g(path, table.number("share", Range(0.0, 1.0), 0.5))
    table.finish()
    return recording
