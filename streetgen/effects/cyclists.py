"""Add cyclists at the edges of both lanes, whose wheels roll and legs pedal with the way ridden."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.cyclist import Cyclist, cyclist_materials, cyclist_parts, riding
from streetgen.geometry.layout import Course
from streetgen.geometry.mesh import F64
from streetgen.geometry.person import BodyPart
from streetgen.geometry.vehicle import world_from_vehicle
from streetgen.geometry.world import Mover, StreetPart, World

BESIDE_M = 3.6
"""Distance from the middle of the road, between traffic in the lane and parked vehicles."""


@dataclass(frozen=True)
class Cyclists:
    """The cyclists' places at time 0, along x from the middle of the street.

    Those of ``along_m`` ride towards +x at the right edge of the road, those of ``oncoming_m``
    towards -x at its left edge. They do not brake, and re-enter the street after leaving it.
    """

    along_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-16.0, 2.0, 27.0)
    oncoming_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-6.0, 19.0, 44.0)
    speed_mps: Annotated[float, Range(0, 15)] = 5.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with the cyclists as movers, one for each part that moves."""
        ways = self.along_m, self.oncoming_m, self.speed_mps
        movers = []
        for _, course in Course.both_ways(*ways, world.layout):
            looks, ahead_m = Cyclist.drawn(rng), float(rng.uniform(0, 10))
            meshes = cyclist_parts(looks)
            movers += [
                Mover(meshes[part[0]], partial(_pose, looks, course, ahead_m, part))
                for part in riding(looks, 0.0)
            ]
        return world.plus(StreetPart((), cyclist_materials(), tuple(movers)))


def _pose(looks: Cyclist, course: Course, ahead_m: float, part: BodyPart, time_s: float) -> F64:
    """Return world_from_part; ``ahead_m`` is how far wheels and crank have turned at time 0."""
    y_m = -course.direction * BESIDE_M
    world_from_cyclist = world_from_vehicle(course.x_m(time_s), y_m, course.heading_rad)
    return world_from_cyclist @ riding(looks, ahead_m + course.speed_mps * time_s)[part]
