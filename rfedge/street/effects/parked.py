"""Parked vehicles in the bays along the kerb, which a field of the empty street has never seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from rfedge.street.geometry.layout import BAY_LENGTH_M, Place
from rfedge.street.geometry.mesh import Mesh
from rfedge.street.geometry.vehicle import Vehicle, standing, vehicle
from rfedge.street.geometry.vehicle_trim import vehicle_materials
from rfedge.street.geometry.world import Part, World

__all__ = ["ParkedVehicles"]

GAP_M = 0.5
ALONG_M, ACROSS_M, TURN_RAD = 0.2, 0.06, 0.015
"""Deviations of how people park."""


@dataclass(frozen=True)
class ParkedVehicles:
    """``occupied``: the share of bays with a vehicle in it."""

    occupied: Annotated[float, Range(0, 1)] = 0.7

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with vehicles in its bays; none is longer than its bay."""
        meshes: list[Mesh] = []
        for bay in world.layout.bays:
            looks, moved = _fitting(rng), rng.normal(0.0, (ALONG_M, ACROSS_M, TURN_RAD))
            if rng.random() < self.occupied:
                meshes += _parked(looks, bay, np.clip(moved, -0.3, 0.3))
        return world.plus(Part(tuple(meshes), vehicle_materials()))


def _fitting(rng: np.random.Generator) -> Vehicle:
    looks = Vehicle.drawn(rng)
    while looks.length_m > BAY_LENGTH_M - GAP_M:
        looks = Vehicle.drawn(rng)
    return looks


def _parked(looks: Vehicle, bay: Place, moved: np.ndarray) -> list[Mesh]:
    along, across, turn = moved.tolist()
    return standing(vehicle(looks), bay.x_m + along, bay.y_m + across, bay.heading_rad + turn)
