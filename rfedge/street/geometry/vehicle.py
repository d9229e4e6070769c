"""Whole vehicles: cars, vans and trucks that stand on the road.

In a vehicle's frame x points forward, y to the left and z up; its origin is on the road below the
middle of its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfedge.street.geometry.mesh import F64, Mesh, joined, placed
from rfedge.street.geometry.vehicle_body import body, surface_of
from rfedge.street.geometry.vehicle_material import LIVERIES, PAINTS, PLATES
from rfedge.street.geometry.vehicle_shape import BODIES, BodyShape
from rfedge.street.geometry.vehicle_trim import trim
from rfedge.street.geometry.vehicle_truck import cargo
from rfedge.street.geometry.vehicle_wheel import wheel

__all__ = ["KINDS", "Vehicle", "standing", "vehicle", "world_from_vehicle"]

TRUCK_LENGTH_M = 7.0
TRUCK_REAR_AXLE_M = 5.35
KINDS = ("hatchback", "saloon", "estate", "suv", "van", "truck")
SHARES = (0.34, 0.20, 0.16, 0.18, 0.09, 0.03)
"""How common each kind is in a European street."""
PAINT_SHARES = (0.19, 0.17, 0.21, 0.17, 0.08, 0.05, 0.06, 0.03, 0.02, 0.02)
WHEEL_INSET_M = 0.035


@dataclass(frozen=True)
class Vehicle:
    """What a vehicle looks like: one of ``KINDS``, its paint, plate and, on a truck, its firm."""

    kind: str
    paint: str
    plate: int = 0
    livery: int = 0
    spokes: int = 7

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Vehicle:
        """Return a vehicle by chance, kinds and paints as common as in a street."""
        kind = KINDS[int(rng.choice(len(KINDS), p=SHARES))]
        paint = tuple(PAINTS)[int(rng.choice(len(PAINTS), p=PAINT_SHARES))]
        plate, livery, spokes = (int(rng.integers(n)) for n in (len(PLATES), len(LIVERIES), 4))
        return cls(kind, paint, plate, livery, 5 + 2 * spokes)

    @property
    def length_m(self) -> float:
        """From nose to tail."""
        return TRUCK_LENGTH_M if self.kind == "truck" else BODIES[self.kind].length_m


def vehicle(looks: Vehicle) -> list[Mesh]:
    """Return a vehicle in its own frame, one mesh a material."""
    shape = BODIES["cab" if looks.kind == "truck" else looks.kind]
    surface = surface_of(shape)
    meshes = [*body(shape, surface, looks.paint), *trim(shape, surface, looks.paint, looks.plate)]
    if looks.kind == "truck":
        shift = np.eye(4)
        shift[0, 3] = 0.5 * (TRUCK_LENGTH_M - shape.length_m)
        meshes = [placed(mesh, shift) for mesh in meshes]
        half = 0.5 * TRUCK_LENGTH_M
        meshes += cargo(half - shape.length_m - 0.08, -half, looks.livery, looks.plate)
    return joined([*meshes, *_wheels(looks, shape)])


def standing(meshes: list[Mesh], x_m: float, y_m: float, heading_rad: float) -> list[Mesh]:
    """Return meshes in a vehicle's frame placed on the road."""
    return [placed(mesh, world_from_vehicle(x_m, y_m, heading_rad)) for mesh in meshes]


def world_from_vehicle(x_m: float, y_m: float, heading_rad: float) -> F64:
    """Return the 4x4 pose of a vehicle on the level road."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[cos, -sin, 0, x_m], [sin, cos, 0, y_m], [0, 0, 1, 0], [0, 0, 0, 1]])


def _wheels(looks: Vehicle, shape: BodyShape) -> list[Mesh]:
    truck = looks.kind == "truck"
    axles = (*shape.axles_m, TRUCK_REAR_AXLE_M) if truck else shape.axles_m
    width = 0.24 if truck else 0.205
    front = 0.5 * looks.length_m
    found = []
    for number, axle in enumerate(axles):
        double = truck and number > 0
        for side in (1, -1):
            y = 0.5 * shape.width_m - WHEEL_INSET_M - 0.5 * width
            for inner in (0.0, width + 0.03) if double else (0.0,):
                pose = np.eye(4)
                pose[:3, 3] = (front - axle, side * (y - inner), shape.wheel_radius_m)
                spokes = wheel(shape.wheel_radius_m, width, looks.spokes, side)
                found += [placed(mesh, pose) for mesh in spokes]
    return found
