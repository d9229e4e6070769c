"""Plan where things are in the street, from the scene's geometry and seed alone.

The street runs along x, centred on 0; traffic keeps right, so the lane towards +x lies at y < 0.
``side`` is +1 for the left edge of the road (y > 0) and -1 for the right one. From the middle
outwards: lane, parking bay, kerb, lamps and trees, pavement, facades.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.tables import Range
from streetgen.geometry.mesh import F64

ROAD_HALF_M = 6.6
KERB_M = 0.3
PAVEMENT_UP_M = 0.14
FACADE_M = 10.2
LANE_M = 2.1
BAY_M, BAY_LENGTH_M = 5.4, 6.2
LAMP_M, TREE_M = 7.3, 7.7
SIGN_M, SIGN_SPACING_M = 7.0, 19.0
CROSSING_SPACING_M, CROSSING_M = 80.0, 3.2
FASCIA_M = (3.35, 3.95)
"""Height of the band over the ground floor that facades leave bare for a sign."""
BEYOND_M = 40.0
"""Length of road and pavement beyond the last facades."""
SIDES = (1, -1)


@dataclass(frozen=True)
class Geometry:
    """The street's measures. ``tiles`` of ``length_m`` each follow one another.

    ``wider_m`` moves everything from the parking bays outwards away from the middle, on either
    side; at 0 the road is 13.2 m wide. ``floors`` are the fewest and the most that houses have
    above the ground floor.
    """

    length_m: Annotated[float, Range(20, 1000)] = 120.0
    tiles: Annotated[int, Range(1, 20)] = 1
    seed: Annotated[int, Range(0, 2**31)] = 1
    trees: bool = True
    signs: bool = True
    wires: bool = True
    wider_m: Annotated[float, Range(0, 6)] = 0.0
    tree_spacing_m: Annotated[float, Range(3, 100)] = 11.0
    lamp_spacing_m: Annotated[float, Range(6, 100)] = 24.0
    floors: Annotated[tuple[int, int], Range(1, 12)] = (2, 5)

    def __post_init__(self) -> None:
        if self.floors[0] > self.floors[1]:
            raise InvalidInput("floors", f"{list(self.floors)} are not the fewest and the most")


@dataclass(frozen=True)
class GroundSpot:
    """A spot on the ground: ``side`` of the road, and the heading (rad, from x towards y)."""

    x_m: float
    y_m: float
    z_m: float
    side: int
    heading_rad: float


@dataclass(frozen=True)
class Plot:
    """A building's ground: from ``start_m`` to ``end_m`` along x, its facade at ``y_m``.

    The facade looks towards the road. The ground floor is ``ground_m`` high, each of the
    ``floors`` above ``floor_m``; ``style`` seeds the looks.
    """

    side: int
    start_m: float
    end_m: float
    y_m: float
    ground_m: float
    floors: int
    floor_m: float
    style: int

    @property
    def width_m(self) -> float:
        """Width of the facade."""
        return self.end_m - self.start_m

    @property
    def height_m(self) -> float:
        """Height from the road to the eaves."""
        return self.ground_m + self.floors * self.floor_m + 0.6

    @property
    def world_from_facade(self) -> F64:
        """4x4 matrix from facade axes (to the right, up, out of the wall) to the world."""
        along = (float(self.side), 0.0, 0.0)
        corner = (self.start_m if self.side > 0 else self.end_m, self.y_m, 0.0)
        outwards = (0.0, -float(self.side), 0.0)
        matrix = np.eye(4)
        matrix[:3] = np.stack([along, (0.0, 0.0, 1.0), outwards, corner], axis=1)
        return matrix


@dataclass(frozen=True)
class Closure:
    """A stretch of one edge of the road, along x, whose parking bays are closed."""

    side: int
    start_m: float
    end_m: float


@dataclass(frozen=True)
class Course:
    """A uniform motion along the street that starts again at the other end.

    ``start_m`` is x at time 0; the other end follows at ``reach_m`` from the middle of the street.
    """

    start_m: float
    direction: int
    speed_mps: float
    reach_m: float

    @staticmethod
    def both_ways(
        along_m: Sequence[float], oncoming_m: Sequence[float], speed_mps: float, layout: Layout
    ) -> Iterator[tuple[int, Course]]:
        """Yield the courses towards +x, then those towards -x, each numbered from 0 of its own."""
        for direction, starts in ((1, along_m), (-1, oncoming_m)):
            for number, start_m in enumerate(starts):
                yield number, Course(start_m, direction, speed_mps, layout.end_m + BEYOND_M)

    def x_m(self, time_s: float) -> float:
        """Return the place along x."""
        moved_m = self.start_m + self.direction * self.speed_mps * time_s
        return (moved_m + self.reach_m) % (2 * self.reach_m) - self.reach_m

    @property
    def heading_rad(self) -> float:
        """The heading, from x towards y."""
        return 0.0 if self.direction > 0 else float(np.pi)


@dataclass(frozen=True)
class Layout:
    """The plan of a street."""

    geometry: Geometry
    closures: tuple[Closure, ...] = ()

    @property
    def start_m(self) -> float:
        """x at which the facades begin."""
        return -0.5 * self.geometry.length_m * self.geometry.tiles

    @property
    def end_m(self) -> float:
        """x at which the facades end."""
        return -self.start_m

    @property
    def road_half_m(self) -> float:
        """Distance from the middle of the road to its edge, where the kerb begins."""
        return ROAD_HALF_M + self.geometry.wider_m

    @property
    def facade_m(self) -> float:
        """Distance from the middle of the road to the facades."""
        return FACADE_M + self.geometry.wider_m

    @cached_property
    def plots(self) -> tuple[Plot, ...]:
        """The buildings, side by side, on both sides."""
        rng = np.random.default_rng([self.geometry.seed, 1])
        return tuple(plot for side in SIDES for plot in self._row(side, rng))

    @cached_property
    def crossings_x_m(self) -> tuple[float, ...]:
        """The middles of the zebra crossings, which are 3.2 m wide along x."""
        first = self.start_m + 0.5 * CROSSING_SPACING_M - 20.0
        return tuple(np.arange(first, self.end_m - 5.0, CROSSING_SPACING_M).tolist())

    @cached_property
    def lamps(self) -> tuple[GroundSpot, ...]:
        """The feet of the lamp posts, staggered; they look towards the road."""
        return self._along(LAMP_M, 8.0, self.geometry.lamp_spacing_m, stagger_m=12.0)

    @cached_property
    def trees(self) -> tuple[GroundSpot, ...]:
        """The feet of the trees, away from lamps and crossings; the headings are random."""
        rng = np.random.default_rng([self.geometry.seed, 2])
        taken = [(lamp.x_m, lamp.side) for lamp in self.lamps]
        kept = []
        for place in self._along(TREE_M, 4.0, self.geometry.tree_spacing_m, stagger_m=5.0):
            moved_m, heading_rad, chance = rng.uniform((-1, 0, 0), (1, 2 * np.pi, 1))
            x_m = place.x_m + moved_m
            free = all(abs(x_m - x) > 2.0 for x, side in taken if side == place.side)
            if chance < 0.8 and free and not self.at_crossing(x_m, 3.0):
                kept.append(GroundSpot(x_m, place.y_m, place.z_m, place.side, heading_rad))
        return tuple(kept)

    @cached_property
    def signposts(self) -> tuple[GroundSpot, ...]:
        """The feet of traffic signs, which face oncoming drivers."""
        found = self._along(SIGN_M, 15.0, SIGN_SPACING_M, stagger_m=9.0)
        return tuple(
            GroundSpot(p.x_m, p.y_m, p.z_m, p.side, 0.0 if p.side > 0 else np.pi) for p in found
        )

    @cached_property
    def bays(self) -> tuple[GroundSpot, ...]:
        """The middles of the open parking bays, away from crossings; headings along the traffic."""
        found = self._along(BAY_M, 5.0, BAY_LENGTH_M, stagger_m=0.0)
        return tuple(
            GroundSpot(p.x_m, p.y_m, 0.0, p.side, np.pi if p.side > 0 else 0.0)
            for p in found
            if not self.at_crossing(p.x_m, 5.0) and not self._closed(p)
        )

    def _closed(self, bay: GroundSpot) -> bool:
        reach_m = 0.5 * BAY_LENGTH_M
        return any(
            c.side == bay.side and c.start_m - reach_m < bay.x_m < c.end_m + reach_m
            for c in self.closures
        )

    def at_crossing(self, x_m: float, margin_m: float) -> bool:
        """Return whether x is on a crossing or nearer to one than the margin."""
        reach_m = 0.5 * CROSSING_M + margin_m
        return any(abs(x_m - crossing) < reach_m for crossing in self.crossings_x_m)

    def _along(
        self, y_m: float, first_m: float, spacing_m: float, stagger_m: float
    ) -> tuple[GroundSpot, ...]:
        """Return evenly spaced spots on both sides; ``y_m`` is for a street of ``wider_m`` 0."""
        y_m += self.geometry.wider_m
        return tuple(
            GroundSpot(float(x), side * y_m, PAVEMENT_UP_M, side, -0.5 * np.pi * side)
            for side in SIDES
            for x in np.arange(
                self.start_m + first_m + (stagger_m if side < 0 else 0.0), self.end_m, spacing_m
            )
        )

    def _row(self, side: int, rng: np.random.Generator) -> list[Plot]:
        plots: list[Plot] = []
        fewest, most = self.geometry.floors
        x = self.start_m
        while x < self.end_m - 6.0:
            if plots and rng.random() < 0.1:
                x += rng.uniform(3.0, 6.0)
            width = rng.uniform(9.0, 17.0)
            plots.append(
                Plot(
                    side=side,
                    start_m=x,
                    end_m=x + width,
                    y_m=side * self.facade_m,
                    ground_m=4.2,
                    floors=int(rng.integers(fewest, most + 1)),
                    floor_m=rng.uniform(3.1, 3.5),
                    style=int(rng.integers(0, 2**31)),
                )
            )
            x += width
        return plots
