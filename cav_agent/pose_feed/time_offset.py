"""How late a feed's times are against the camera's, from the poses the field gave.

A fix stamped t that was the vehicle's position at t + tau lies off the true path by about
velocity * tau; a bias adds the same everywhere. Over fixes with errors e and velocities v,

    e = bias + v tau + noise,

the least-squares tau is sum (v - mean v)(e - mean e) / sum |v - mean v|^2: it is known as far as
the velocity has changed, in size or direction. A machine; old fixes are forgotten.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from rfcore.camera import Vec3
from rfcore.errors import InvalidInput

__all__ = ["TimeOffset", "TimeOffsetEstimator"]

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
