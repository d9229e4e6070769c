"""Times during which nothing gets through: a tunnel, a handover, a dead spot.

While a link is out its transmission stands still, and so does a trace; what is in propagation
arrives. Afterwards it goes on where it was. Declared by times, repeated if wanted, or at random
with exponential lengths of being up and down.

In a profile: ``[uplink.outage]`` with ``at_s = [[from, for], ...]`` and ``repeat_s``, or with
``mean_up_s`` and ``mean_down_s``.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from random import Random

from rfcore.errors import InvalidInput
from rfcore.link.plan import Parts
from rfcore.link.shaper import Transmission
from rfcore.tables import Range, Table, shortened

__all__ = ["Outage", "OutageTransmission", "RandomOutage", "parse"]

Window = tuple[float, float]
"""(first second without the link, first second with it)"""

MAX_S = 1e6
LENGTH_S = Range(1e-3, MAX_S)


@dataclass(frozen=True)
class Outage:
    """Out during ``windows_s``, ascending and apart; again every ``repeat_s`` seconds if given."""

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

    def apply(self, parts: Parts, random: Random) -> Parts:  # noqa: ARG002
        """Interrupt the transmission."""
        outages = OutageTransmission(parts.transmission, self.windows())
        return replace(parts, transmission=outages)


@dataclass(frozen=True)
class RandomOutage:
    """Up and down in turn, for exponentially distributed times of these means."""

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

    def apply(self, parts: Parts, random: Random) -> Parts:
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


def parse(table: Table) -> Outage | RandomOutage:
    """Return the impairment that a profile's table declares."""
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
