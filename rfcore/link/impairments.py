"""Impairments of a link that are computed: outages and jitter.

*Outage*: nothing gets through, as in a tunnel, during a handover or in a dead spot. The
transmission stands still, and so does a trace; what is in propagation arrives. Afterwards it goes
on where it was. In a profile: ``[uplink.outage]`` with ``at_s = [[from, for], ...]`` and
``repeat_s``, or with ``mean_up_s`` and ``mean_down_s`` for exponentially distributed lengths.

*Jitter*: a random delay on top of the constant one. Packets keep their order: one that draws little
waits behind one that drew much, as with a radio link that retransmits. In a profile:
``[uplink.jitter]`` with ``spread_ms`` and ``distribution``, which is ``uniform`` (between 0 and the
spread) or ``exponential`` (the spread is the mean, cut off at ten times that).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from random import Random

from rfcore.errors import InvalidInput
from rfcore.link.shaper import LinkParts, Transmission
from rfcore.tables import Range, Table, shortened

Window = tuple[float, float]
"""(first second without the link, first second with it)"""

MAX_S = 1e6
LENGTH_S = Range(1e-3, MAX_S)
MAX_SPREAD_S = 5.0
LONGEST = 10.0
"""Cut of the exponential distribution, in means: one packet in 22 000 is beyond it."""


@dataclass(frozen=True)
class Outage:
    """The link is out during ``windows_s``, ascending and apart, and again every ``repeat_s``."""

    windows_s: tuple[Window, ...]
    repeat_s: float | None = None
    name: str = "outage"

    def __post_init__(self) -> None:
        edges = [edge for window in self.windows_s for edge in window]
        if not edges or edges[0] < 0 or any(not a < b for a, b in itertools.pairwise(edges)):
            raise InvalidInput("outage", f"{self.windows_s} must be times that ascend, apart")
        if self.repeat_s is not None and not self.repeat_s >= edges[-1]:
            raise InvalidInput(
                "outage.repeat_s", f"{self.repeat_s} s is before the last outage ends, {edges[-1]}"
            )

    def windows(self) -> Iterator[Window]:
        """Yield the outages in order, without end if they repeat."""
        if self.repeat_s is None:
            yield from self.windows_s
            return
        for number in itertools.count():
            shift_s = number * self.repeat_s
            yield from ((begin + shift_s, end + shift_s) for begin, end in self.windows_s)

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:  # noqa: ARG002
        """Interrupt the transmission."""
        outages = OutageTransmission(parts.transmission, self.windows())
        return replace(parts, transmission=outages)


@dataclass(frozen=True)
class RandomOutage:
    """The link is up and down in turn, for exponentially distributed times of these means."""

    mean_up_s: float
    mean_down_s: float
    name: str = "outage"

    def windows(self, random: Random) -> Iterator[Window]:
        """Yield outages without end."""
        now_s = 0.0
        while True:
            begin_s = now_s + random.expovariate(1.0 / self.mean_up_s)
            now_s = begin_s + random.expovariate(1.0 / self.mean_down_s)
            if now_s > begin_s:
                yield begin_s, now_s

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:
        """Interrupt the transmission."""
        outages = OutageTransmission(parts.transmission, self.windows(random))
        return replace(parts, transmission=outages)


class OutageTransmission:
    """Runs ``inner`` on a clock that stands still during ``windows``; time does not run back."""

    def __init__(self, inner: Transmission, windows: Iterator[Window]) -> None:
        self._inner = inner
        self._windows = windows
        self._ahead: deque[Window] = deque()
        self._down_s = 0.0

    def schedule(self, size_bytes: int, at_s: float) -> tuple[float, float]:
        """Return start and end of transmission."""
        up_s, ready_s = self._up_until(at_s)
        start_s, end_s = self._inner.schedule(size_bytes, up_s)
        return max(ready_s, self._wall(start_s)), max(ready_s, self._wall(end_s))

    def _up_until(self, at_s: float) -> tuple[float, float]:
        """Return how long the link was up before ``at_s``, and when it is up from then on."""
        for begin_s, end_s in self._coming():
            if begin_s > at_s:
                break
            if at_s < end_s:
                return begin_s - self._down_s, end_s
            self._down_s += end_s - begin_s
            self._ahead.popleft()
        return at_s - self._down_s, at_s

    def _wall(self, up_s: float) -> float:
        """Return the earliest second at which the link has been up for ``up_s`` seconds."""
        wall_s = up_s + self._down_s
        for begin_s, end_s in self._coming():
            if begin_s >= wall_s:
                break
            wall_s += end_s - begin_s
        return wall_s

    def _coming(self) -> Iterator[Window]:
        """Yield the outages that are not over, in order; drawn as far as somebody looks."""
        yield from tuple(self._ahead)
        for window in self._windows:
            self._ahead.append(window)
            yield window


class JitterDistribution(StrEnum):
    """How the delay is drawn."""

    UNIFORM = "uniform"
    EXPONENTIAL = "exponential"


@dataclass(frozen=True)
class Jitter:
    """``spread_s`` is the longest delay if uniform, the mean if exponential."""

    spread_s: float
    distribution: JitterDistribution = JitterDistribution.UNIFORM
    name: str = "jitter"

    def __post_init__(self) -> None:
        if not 0.0 <= self.spread_s <= MAX_SPREAD_S:
            raise InvalidInput("jitter", f"{self.spread_s} s is outside 0..{MAX_SPREAD_S:g} s")

    def apply(self, parts: LinkParts, random: Random) -> LinkParts:
        """Add this delay."""

        def delay_s(at_s: float) -> float:  # noqa: ARG001
            if self.distribution is JitterDistribution.UNIFORM:
                return random.uniform(0.0, self.spread_s)
            return self.spread_s * min(LONGEST, random.expovariate(1.0))

        return parts.with_delay(delay_s)


def parse_impairment(name: str, table: Table) -> Outage | RandomOutage | Jitter:
    """Return the impairment that a profile's table of that name declares."""
    if name == "outage":
        return _outage(table)
    spread_s = table.number("spread_ms", Range(0.0, 1e3 * MAX_SPREAD_S)) / 1e3
    named = table.choice("distribution", JitterDistribution, "uniform")
    table.finish()
    return Jitter(spread_s, JitterDistribution(named))


def _outage(table: Table) -> Outage | RandomOutage:
    if "at_s" not in table:
        up_s, down_s = (table.number(f"mean_{name}_s", LENGTH_S) for name in ("up", "down"))
        table.finish("at_s")
        return RandomOutage(up_s, down_s)
    windows = []
    for index, pair in enumerate(table.items("at_s")):
        if not isinstance(pair, list) or len(pair) != 2:
            raise table.error(f"at_s[{index}]", f"is {shortened(pair)}, not [from_s, for_s]")
        begin_s = table.checked(f"at_s[{index}][0]", pair[0], Range(0.0, MAX_S))
        windows.append((begin_s, begin_s + table.checked(f"at_s[{index}][1]", pair[1], LENGTH_S)))
    repeat_s = table.number("repeat_s", LENGTH_S) if "repeat_s" in table else None
    table.finish("repeat_s")
    return Outage(tuple(windows), repeat_s)
