"""Moving vehicles: they keep right, hold their speed, and re-enter the street after leaving it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from rfedge.street.geometry.layout import BEYOND_M, LANE_M, Course
from rfedge.street.geometry.mesh import F64
from rfedge.street.geometry.vehicle import Vehicle, vehicle, world_from_vehicle
from rfedge.street.geometry.vehicle_trim import vehicle_materials
from rfedge.street.geometry.world import Mover, Part, World

__all__ = ["Traffic"]


@dataclass(frozen=True)
class Traffic:
    """Vehicles by their places at time 0, along x from the middle of the street.

    Those of ``along_m`` drive towards +x, as the drive's camera does, those of ``oncoming_m``
    towards -x. Vehicles do not brake: one at the camera's place is seen from inside.
    """

    along_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-29.0, 17.2, 40.0)
    oncoming_m: Annotated[tuple[float, ...], Range(-1000, 1000)] = (-17.0, 6.0, 28.8, 52.0)
    speed_mps: Annotated[float, Range(0, 60)] = 9.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with the vehicles as movers."""
        reach_m = world.layout.end_m + BEYOND_M
        movers = []
        for direction, starts in ((1, self.along_m), (-1, self.oncoming_m)):
            for start_m in starts:
                course = Course(start_m, direction, self.speed_mps, reach_m)
                meshes = tuple(vehicle(Vehicle.drawn(rng)))
                movers.append(Mover(meshes, partial(_pose, course)))
        return world.plus(Part((), vehicle_materials(), tuple(movers)))


def _pose(course: Course, time_s: float) -> F64:
    y_m = -course.direction * LANE_M
    return world_from_vehicle(course.x_m(time_s), y_m, course.heading_rad)
