"""Connections that are cut at random: each lives for an exponentially distributed time.

A proxy of TCP cannot lose packets, only whole connections; losing packets shows as delay (jitter)
and lower rate. In a profile: ``[connection_loss]`` with ``mean_life_s``.
"""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from rfcore.errors import InvalidInput
from rfcore.tables import Range, Table

__all__ = ["ConnectionLoss", "RandomLives", "parse"]

LIFE_S = Range(0.05, 1e6)


@dataclass(frozen=True)
class ConnectionLoss:
    """``mean_life_s``: how long a connection lives on average."""

    mean_life_s: float

    def __post_init__(self) -> None:
        if problem := LIFE_S.problem(self.mean_life_s):
            raise InvalidInput("connection_loss.mean_life_s", f"{problem} s")

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


def parse(table: Table) -> ConnectionLoss:
    """Return what a profile's table declares."""
    loss = ConnectionLoss(table.number("mean_life_s", LIFE_S))
    table.finish()
    return loss
