"""Park vehicles in the bays along the kerb, which a field of the empty street has never seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.layout import BAY_LENGTH_M, GroundSpot, Layout
from streetgen.geometry.mesh import Mesh
from streetgen.geometry.vehicle import VehicleLooks, standing, vehicle
from streetgen.geometry.vehicle_trim import vehicle_materials
from streetgen.geometry.world import StreetPart, World

GAP_M = 0.5
ALONG_M, ACROSS_M, TURN_RAD = 0.2, 0.06, 0.015
"""Standard deviations of a vehicle's place and heading from its bay."""


@dataclass(frozen=True)
class ParkedVehicles:
    """The share of bays that are ``occupied``.

    On another ``day`` than 0 the share ``turnover`` of the bays has another vehicle or none.
    """

    occupied: Annotated[float, Range(0, 1)] = 0.7
    day: Annotated[int, Range(0, 10_000)] = 0
    turnover: Annotated[float, Range(0, 1)] = 0.5

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with vehicles in its bays; none is longer than its bay."""
        meshes: list[Mesh] = []
        chance = int(rng.spawn(1)[0].integers(2**63))
        today = np.random.default_rng([chance, self.day]) if self.day else None
        for bay in Layout(world.layout.geometry).bays:
            vehicle_in = self._drawn(rng)
            if today is not None and today.random() < self.turnover:
                vehicle_in = self._drawn(today)
            if vehicle_in is not None and bay in world.layout.bays:
                meshes += _parked(vehicle_in[0], bay, vehicle_in[1])
        return world.plus(StreetPart(tuple(meshes), vehicle_materials()))

    def _drawn(self, rng: np.random.Generator) -> tuple[VehicleLooks, np.ndarray] | None:
        """Return a vehicle and its deviation from the bay, or None for an empty bay."""
        looks, moved = _fitting(rng), rng.normal(0.0, (ALONG_M, ACROSS_M, TURN_RAD))
        return (looks, np.clip(moved, -0.3, 0.3)) if rng.random() < self.occupied else None


def _fitting(rng: np.random.Generator) -> VehicleLooks:
    looks = VehicleLooks.drawn(rng)
    while looks.length_m > BAY_LENGTH_M - GAP_M:
        looks = VehicleLooks.drawn(rng)
    return looks


def _parked(looks: VehicleLooks, bay: GroundSpot, moved: np.ndarray) -> list[Mesh]:
    along, across, turn = moved.tolist()
    return standing(vehicle(looks), bay.x_m + along, bay.y_m + across, bay.heading_rad + turn)
