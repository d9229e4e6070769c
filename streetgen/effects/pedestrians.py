"""Add people who walk along the pavements and across the road."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.layout import KERB_M, PAVEMENT_UP_M, Course
from streetgen.geometry.mesh import F64
from streetgen.geometry.person import (
    BodyPart,
    Person,
    body_parts,
    person_materials,
    stride_m,
    walking,
)
from streetgen.geometry.vehicle import world_from_vehicle
from streetgen.geometry.world import Mover, StreetPart, World

NEAR_M, FAR_M = 1.9, 2.9
"""The part of the pavement that is free to walk on, as distances from the edge of the road."""
TURN_BACK_M = 2.2
"""Distance from the road's edge at which people who cross it turn back."""
USUAL_MPS = 1.4
Way = Callable[[float], tuple[float, F64]]
"""Maps a time (s) to the way walked (m) and world_from_person (4x4)."""


@dataclass(frozen=True)
class Pedestrians:
    """The people's places at time 0, along x from the middle of the street.

    Those of ``along_m`` walk towards +x, those of ``oncoming_m`` towards -x, by turns on the right
    pavement and on the left. Those of ``crossing_m`` cross the road at that x, beginning by turns
    at its right kerb and at its left, and come back from the other side. Nobody gives way: where
    somebody stands or drives they walk through.
    """

    along_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-22.0, -9.0, 3.0, 14.0, 31.0)
    oncoming_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-14.0, 1.0, 9.0, 22.0, 37.0)
    crossing_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (12.0,)
    speed_mps: Annotated[float, Range(0, 3)] = USUAL_MPS

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with the people as movers, one for each part of a body."""
        ways = self.along_m, self.oncoming_m, self.speed_mps
        half_m = world.layout.road_half_m
        movers: list[Mover] = []
        for number, course in Course.both_ways(*ways, world.layout):
            y_m = (-1) ** (number + 1) * (half_m + float(rng.uniform(NEAR_M, FAR_M)))
            movers += self._walker(partial(_on_pavement, course, y_m), rng)
        for number, x_m in enumerate(self.crossing_m):
            way = partial(_crossing, x_m, (-1) ** (number + 1), half_m, self.speed_mps)
            movers += self._walker(way, rng)
        return world.plus(StreetPart((), person_materials(), tuple(movers)))

    def _walker(self, way: Way, rng: np.random.Generator) -> list[Mover]:
        looks, phase_rad = Person.drawn(rng), float(rng.uniform(0, 2 * np.pi))
        walker = Walker(looks, way, self.speed_mps / USUAL_MPS, phase_rad)
        meshes = body_parts(looks)
        return [
            Mover(meshes[part[0]], partial(walker.world_from_part, part))
            for part in walking(looks, 0.0, 0.0)
        ]


@dataclass(frozen=True)
class Walker:
    """A person on a way; steps follow from the way walked, so that feet do not slide far."""

    looks: Person
    way: Way
    pace: float
    """The speed as a multiple of the usual one; steps are longer by the same factor."""
    phase_rad: float

    def world_from_part(self, part: BodyPart, time_s: float) -> F64:
        """Return a part's pose, 4x4."""
        walked_m, world_from_person = self.way(time_s)
        swing = min(self.pace, 1.3)
        stride = stride_m(self.looks, swing)
        turns = walked_m / stride if stride > 0 else 0.0
        posed = walking(self.looks, self.phase_rad + 2 * np.pi * turns, swing)
        return world_from_person @ posed[part]


def _on_pavement(course: Course, y_m: float, time_s: float) -> tuple[float, F64]:
    pose = world_from_vehicle(course.x_m(time_s), y_m, course.heading_rad)
    pose[2, 3] = PAVEMENT_UP_M
    return course.speed_mps * time_s, pose


def _crossing(
    x_m: float, side: int, half_m: float, speed_mps: float, time_s: float
) -> tuple[float, F64]:
    """Return the way walked and the pose of a person who crosses the road to and fro for ever.

    The road is ``2 * half_m`` wide; the person begins at the kerb of ``side``."""
    walked_m, turn_m = speed_mps * time_s, half_m + TURN_BACK_M
    way_m = (walked_m + TURN_BACK_M) % (4 * turn_m)
    there = way_m < 2 * turn_m
    y_m = side * (turn_m - way_m if there else way_m - 3 * turn_m)
    heading_rad = -side * 0.5 * np.pi if there else side * 0.5 * np.pi
    pose = world_from_vehicle(x_m, y_m, heading_rad)
    pose[2, 3] = PAVEMENT_UP_M * np.clip((abs(y_m) - half_m + KERB_M) / KERB_M, 0.0, 1.0)
    return walked_m, pose
