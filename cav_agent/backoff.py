"""Exponential back-off with jitter: how long to wait before something is tried again.

The pause doubles with every failure in a row, up to a longest one, and half of it is left to
chance. So the vehicles that lost one server do not all come back to it at once ("equal
jitter": <https://aws.amazon.com/blogs/architecture/exponential-backoff-and-jitter/>).
"""

from __future__ import annotations

import random
from collections.abc import Callable

from rfcore.errors import InvalidInput


class Backoff:
    """Pauses between tries; ``chance`` returns numbers of 0..1, evenly distributed."""

    def __init__(
        self, first_s: float, longest_s: float, chance: Callable[[], float] = random.random
    ) -> None:
        if not 0 < first_s <= longest_s:
            raise InvalidInput("backoff", f"{first_s:g} s is outside 0..{longest_s:g} s")
        self._first_s = first_s
        self._longest_s = longest_s
        self._chance = chance
        self._pause_s = first_s

    def next_s(self) -> float:
        """Return how long to wait after one more failure."""
        pause_s = self._pause_s
        self._pause_s = min(2 * pause_s, self._longest_s)
        return pause_s * (0.5 + 0.5 * self._chance())

    def reset(self) -> None:
        """Begin again with the shortest pause, after a success."""
        self._pause_s = self._first_s
