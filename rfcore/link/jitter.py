"""A random delay on top of the constant one; packets keep their order.

``uniform``: between 0 and ``spread_ms``. ``exponential``: with the mean ``spread_ms``, cut off at
ten times that. Order is kept by waiting: a packet that draws little comes out right behind one that
drew much, as with a radio link that retransmits.

In a profile: ``[uplink.jitter]`` with ``spread_ms`` and ``distribution``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from random import Random

from rfcore.errors import InvalidInput
from rfcore.link.plan import Parts
from rfcore.tables import Range, Table

__all__ = ["Distribution", "Jitter", "JitterDelay", "parse"]

LONGEST = 10.0
"""Cut of the exponential distribution, in means: one packet in 22 000 is beyond it."""

MAX_SPREAD_S = 5.0


class Distribution(StrEnum):
    """How the delay is drawn."""

    UNIFORM = "uniform"
    EXPONENTIAL = "exponential"


@dataclass(frozen=True)
class Jitter:
    """``spread_s``: the longest delay if uniform, the mean if exponential."""

    spread_s: float
    distribution: Distribution = Distribution.UNIFORM
    name: str = "jitter"

    def __post_init__(self) -> None:
        if not 0.0 <= self.spread_s <= MAX_SPREAD_S:
            raise InvalidInput("jitter", f"{self.spread_s} s is outside 0..{MAX_SPREAD_S:g} s")

    def apply(self, parts: Parts, random: Random) -> Parts:
        """Add this delay."""
        return parts.with_delay(JitterDelay(self, random))


class JitterDelay:
    """Draws the delay of one packet after another."""

    def __init__(self, jitter: Jitter, random: Random) -> None:
        self._jitter = jitter
        self._random = random

    def delay_s(self, at_s: float) -> float:  # noqa: ARG002
        """Return the next packet's delay."""
        spread_s = self._jitter.spread_s
        if self._jitter.distribution is Distribution.UNIFORM:
            return self._random.uniform(0.0, spread_s)
        return spread_s * min(LONGEST, self._random.expovariate(1.0))


def parse(table: Table) -> Jitter:
    """Return the impairment that a profile's table declares."""
    spread_s = table.number("spread_ms", Range(0.0, 1e3 * MAX_SPREAD_S)) / 1e3
    named = table.choice("distribution", Distribution, "uniform")
    table.finish()
    return Jitter(spread_s, Distribution(named))
