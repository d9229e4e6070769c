"""Add vehicles that keep right, hold their speed, and re-enter the street after leaving it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.layout import LANE_M, Course
from streetgen.geometry.mesh import F64
from streetgen.geometry.vehicle import VehicleLooks, vehicle, world_from_vehicle
from streetgen.geometry.vehicle_trim import vehicle_materials
from streetgen.geometry.world import Mover, StreetPart, World


@dataclass(frozen=True)
class Traffic:
    """The vehicles' places at time 0, along x from the middle of the street.

    Those of ``along_m`` drive towards +x, as the drive's camera does, those of ``oncoming_m``
    towards -x. Vehicles do not brake: one at the camera's place is seen from inside.
    """

    along_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-29.0, 17.2, 40.0)
    oncoming_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-17.0, 6.0, 28.8, 52.0)
    speed_mps: Annotated[float, Range(0, 60)] = 9.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with the vehicles as movers."""
        ways = self.along_m, self.oncoming_m, self.speed_mps
        movers = tuple(
            Mover(tuple(vehicle(VehicleLooks.drawn(rng))), partial(_pose, course))
            for _, course in Course.both_ways(*ways, world.layout)
        )
        return world.plus(StreetPart((), vehicle_materials(), movers))


def _pose(course: Course, time_s: float) -> F64:
    y_m = -course.direction * LANE_M
    return world_from_vehicle(course.x_m(time_s), y_m, course.heading_rad)
