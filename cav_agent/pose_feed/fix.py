"""One pose of the vehicle as a sensor states it, and what can be wrong with a feed of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from enum import StrEnum

from rfcore.camera import Vec3
from rfcore.errors import InvalidData

__all__ = ["BadReading", "FeedProblem", "Fix", "finite"]

Rotation = tuple[float, float, float, float]


class FeedProblem(StrEnum):
    """A problem of a feed: a closed set, fit for a metric's label."""

    MALFORMED = "malformed"
    """A line is none of the formats, or lacks what it must have."""
    CHECKSUM = "checksum"
    """An NMEA sentence has no checksum, or another one than its bytes."""
    NOT_FINITE = "not_finite"
    """A number is NaN, infinite, or outside what it can be on the Earth."""
    NO_FIX = "no_fix"
    """The receiver itself says that it knows no position."""
    BACKWARDS = "backwards"
    """A fix is not younger than the one before."""
    CLOCK = "clock"
    """The feed's clock is not the agent's; times are shifted by the difference."""
    JUMP = "jump"
    """The position moved faster than a vehicle does. It is used: the field shows if it is true."""
    OUTSIDE = "outside"
    """The position is outside the field's bounds."""
    NO_ANCHOR = "no_anchor"
    """The feed is on the Earth, and the field does not say where it is."""
    SILENT = "silent"
    """Nothing came for longer than usual."""
    LOST = "lost"
    """The source cannot be read; it is tried again."""


class BadReading(InvalidData):
    """A line of a feed cannot be used; ``problem`` says why in one word."""

    def __init__(self, problem: FeedProblem, text: str) -> None:
        super().__init__(f"{problem}: {text}")
        self.problem = problem


@dataclass(frozen=True)
class Fix:
    """The vehicle's pose at ``time_ns`` of the feed's clock, nanoseconds of the Unix epoch.

    Either ``geodetic``, latitude and longitude in degrees and height in metres above the ellipsoid
    of WGS 84 (``None``: not measured), or ``xyz_m`` in the global metric frame of the drives.
    ``heading_deg``: of the vehicle's x axis, clockwise from north. ``rotation``: of the vehicle's
    axes (x forward, y left, z up) to east, north, up, or to the global frame with ``xyz_m``; it
    takes precedence over the heading. Standard deviations: one sigma, in metres along the axes of
    the position.
    """

    time_ns: int
    geodetic: tuple[float, float, float | None] | None
    xyz_m: Vec3 | None
    position_std_m: Vec3
    heading_deg: float | None = None
    rotation: Rotation | None = None
    rotation_std_deg: float = 3.0


def finite(name: str, value: object, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a number of a reading; raise ``BadReading`` for anything else, or out of range."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str, Decimal)):
        raise BadReading(FeedProblem.MALFORMED, f"{name} is {value!r}, not a number")
    try:
        number = float(value)
    except (ValueError, OverflowError) as error:
        raise BadReading(FeedProblem.MALFORMED, f"{name} is {value!r}, not a number") from error
    if not (math.isfinite(number) and low <= number <= high):
        raise BadReading(FeedProblem.NOT_FINITE, f"{name} is {number}, outside {low:g}..{high:g}")
    return number
