"""Connections that are cut at random: each lives for an exponentially distributed time.

A proxy of TCP cannot lose packets, only whole connections; losing packets shows as delay (jitter)
and lower rate. In a profile: ``[connection_loss]`` with ``mean_life_s``.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from rfcore.errors import InvalidInput
from rfcore.link.section import Section

__all__ = ["ConnectionLoss", "RandomLives", "parse"]

LIFE_LIMITS_S = (0.05, 1e6)


@dataclass(frozen=True)
class ConnectionLoss:
    """``mean_life_s``: how long a connection lives on average."""

    mean_life_s: float

    def __post_init__(self) -> None:
        lowest, highest = LIFE_LIMITS_S
        if not lowest <= self.mean_life_s <= highest:
            raise InvalidInput(
                "connection_loss.mean_life_s",
                f"{self.mean_life_s} is outside {lowest:g}..{highest:g} s",
            )

    def lives(self, random: Random) -> RandomLives:
        """Return the machine that says how long connections live."""
        return RandomLives(self.mean_life_s, random)


class RandomLives:
    """Draws one connection's life after another."""

    def __init__(self, mean_life_s: float, random: Random) -> None:
        self._mean_life_s = mean_life_s
        self._random = random

    def lifetime_s(self) -> float:
        """Return the seconds after which the next connection is cut."""
        return self._mean_life_s * self._random.expovariate(1.0)


def parse(section: Section) -> ConnectionLoss:
    """Return what a profile's section declares."""
    loss = ConnectionLoss(section.number("mean_life_s", LIFE_LIMITS_S))
    section.finish()
    return loss
