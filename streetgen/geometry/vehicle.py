"""Make whole vehicles: cars, vans and delivery trucks, with wheels and cargo box.

In a vehicle's frame x points forward, y to the left and z up; its origin is on the road below the
middle of its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from streetgen.classes import Label
from streetgen.geometry.mesh import F64, Mesh, joined, placed
from streetgen.geometry.signage import atlas_uv
from streetgen.geometry.solids import Surface, boxes, disc, quads, tube
from streetgen.geometry.vehicle_body import body, surface_of
from streetgen.geometry.vehicle_shape import BODIES, BodyShape
from streetgen.geometry.vehicle_trim import LIVERIES, PAINTS, PLATES, number_plate, trim

WALL = Surface("livery", Label.VEHICLE)
EDGE = Surface("car chrome", Label.VEHICLE)
TRIM = Surface("car trim", Label.VEHICLE)
LAMP = Surface("car tail lamp", Label.VEHICLE)
BOX_LOW_M, BOX_HIGH_M = 1.02, 3.25
HALF_WIDTH_M = 1.16
EDGE_M = 0.05


def cargo(front_m: float, rear_m: float, livery: int, plate: int) -> list[Mesh]:
    """Return the box between two places along x, the front one larger, and what is under it."""
    y, low, high = HALF_WIDTH_M, BOX_LOW_M, BOX_HIGH_M
    corners = {
        "left": [(front_m, y), (rear_m, y)],
        "right": [(rear_m, -y), (front_m, -y)],
        "rear": [(rear_m, y), (rear_m, -y)],
        "front": [(front_m, -y), (front_m, y)],
    }
    lettered, plain = atlas_uv(len(LIVERIES), livery), _paper_uv(livery)
    meshes = [
        _wall(ends[0], ends[1], lettered if side in ("left", "right") else plain)
        for side, ends in corners.items()
    ]
    roof = [(front_m, -y, high), (front_m, y, high), (rear_m, y, high), (rear_m, -y, high)]
    floor = [(front_m, y, low), (front_m, -y, low), (rear_m, -y, low), (rear_m, y, low)]
    meshes += [quads(WALL, [roof], plain[None]), quads(TRIM, [floor])]
    return [*meshes, *_edges(front_m, rear_m), *_below(front_m, rear_m), *_tail(rear_m, plate)]


def _wall(start: tuple[float, float], end: tuple[float, float], uv: np.ndarray) -> Mesh:
    """Return an upright rectangle; seen from outside ``start`` is on its right."""
    (x0, y0), (x1, y1) = end, start
    low, high = BOX_LOW_M, BOX_HIGH_M
    return quads(WALL, [[(x1, y1, low), (x0, y0, low), (x0, y0, high), (x1, y1, high)]], uv[None])


def _paper_uv(livery: int) -> np.ndarray:
    """Return the uv of a corner of the firm's board that has no letters."""
    uv = atlas_uv(len(LIVERIES), livery)
    return np.asarray(uv[:1] + (uv[2] - uv[0]) * 0.02 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))


def _edges(front_m: float, rear_m: float) -> list[Mesh]:
    """Return metal rails along all edges of the box."""
    y, low, high, t = HALF_WIDTH_M, BOX_LOW_M, BOX_HIGH_M, EDGE_M
    found = []
    for z in (low, high):
        below, above = z - t, z + t / 3
        for s in (y, -y):
            ends = (rear_m - 0.01, s - t / 2, below), (front_m + 0.01, s + t / 2, above)
            found.append(boxes(EDGE, *ends))
        found += [
            boxes(EDGE, (x - t / 2, -y, below), (x + t / 2, y, above)) for x in (rear_m, front_m)
        ]
    for x in (rear_m, front_m):
        found += [boxes(EDGE, (x - t, s - t / 2, low), (x + t, s + t / 2, high)) for s in (y, -y)]
    return found


def _below(front_m: float, rear_m: float) -> list[Mesh]:
    """Return the frame, a tank, and the guards along the sides."""
    frame = [
        boxes(TRIM, (rear_m + 0.1, y - 0.06, 0.72), (front_m + 0.4, y + 0.06, 1.0))
        for y in (0.42, -0.42)
    ]
    length = front_m - rear_m
    tank = boxes(TRIM, (front_m - 0.34 * length, 0.62, 0.42), (front_m - 0.12 * length, 1.08, 0.9))
    guards = [
        tube(TRIM, [(front_m - 0.1, y, z), (rear_m + 0.42 * length, y, z)], 0.025, 6)
        for y in (1.12, -1.12)
        for z in (0.5, 0.78)
    ]
    return [*frame, tank, *guards]


def _tail(rear_m: float, plate: int) -> list[Mesh]:
    """Return underrun bar, lamps, the door's gap with its locking bars, and number plate."""
    y = HALF_WIDTH_M
    bar = boxes(TRIM, (rear_m + 0.02, -y, 0.45), (rear_m + 0.1, y, 0.60))
    holder = boxes(TRIM, (rear_m + 0.04, -0.6, 0.55), (rear_m + 0.1, 0.6, 1.0))
    lamps = [
        boxes(LAMP, (rear_m - 0.02, s * 0.93 - 0.16, 0.72), (rear_m + 0.05, s * 0.93 + 0.16, 0.88))
        for s in (1, -1)
    ]
    bars = [
        tube(EDGE, [(rear_m - 0.03, s, 1.05), (rear_m - 0.03, s, 3.2)], 0.016, 6)
        for s in (-0.75, -0.2, 0.2, 0.75)
    ]
    gap = boxes(TRIM, (rear_m - 0.008, -0.008, 1.05), (rear_m, 0.008, 3.2))
    return [
        bar,
        holder,
        *lamps,
        *bars,
        gap,
        number_plate(np.array([rear_m + 0.01, 0, 0.72]), -1.0, plate),
    ]


SIDES = 32
TYRE = Surface("tyre", Label.VEHICLE)
RIM = Surface("rim", Label.VEHICLE)
DARK = Surface("car gap", Label.VEHICLE)
BRAKE = Surface("brake disc", Label.VEHICLE)
TYRE_PROFILE = (
    *((0.66, 0.42), (0.70, 0.47), (0.80, 0.5), (0.92, 0.49), (0.985, 0.43), (1.0, 0.36)),
    *((1.0, -0.36), (0.985, -0.43), (0.92, -0.49), (0.70, -0.47), (0.66, -0.42)),
)
"""Points of the profile, outside first: radius as a share of the wheel's, place across as a share
of the tyre's width."""
RIM_PROFILE = ((0.67, 0.44), (0.645, 0.445), (0.62, 0.40), (0.60, 0.1))
RIM_RADIUS, HUB_RADIUS = 0.63, 0.17
SPOKE_OUT = (0.34, 0.40)
"""Places of the spokes' faces across the width, at the hub and at the rim."""


def wheel(radius_m: float, width_m: float, spokes: int, outside: int) -> list[Mesh]:
    """Return a wheel about the y axis with its middle at the origin; ``outside`` is +1 or -1."""
    parts = [
        revolved(TYRE, np.array(TYRE_PROFILE) * (radius_m, width_m), SIDES),
        revolved(RIM, np.array(RIM_PROFILE) * (radius_m, width_m), SIDES),
        disc(DARK, (0, 0.02 * width_m, 0), (0, 1, 0), 0.61 * radius_m, SIDES),
        disc(BRAKE, (0, 0.10 * width_m, 0), (0, 1, 0), 0.45 * radius_m, 20),
        _spokes(radius_m, width_m, spokes),
        disc(RIM, (0, 0.36 * width_m, 0), (0, 1, 0), HUB_RADIUS * radius_m, 16),
    ]
    turned = np.diag([float(outside), float(outside), 1.0, 1.0])
    return [placed(part, turned) for part in parts]


def revolved(made_of: Surface, profile: ArrayLike, sides: int) -> Mesh:
    """Return the surface of a profile [N, 2] of (radius, y) turned about the y axis, smooth.

    Seen from outside the profile runs from the +y end to the -y end.
    """
    points = np.asarray(profile, np.float64)
    along = np.gradient(points, axis=0)
    out = np.stack([-along[:, 1], along[:, 0]], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    rows, columns = len(points), sides + 1
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(sides)[None]).reshape(-1)
    corners = np.stack([first, first + columns, first + columns + 1, first + 1], axis=1)
    uv = np.stack(np.broadcast_arrays(turn[None] / (2 * np.pi), points[:, 1:]), axis=-1)
    return Mesh(
        vertices=_about_y(points, turn).astype(np.float32),
        faces=corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32),
        uv=np.ascontiguousarray(uv.reshape(-1, 2), np.float32),
        material=made_of.material,
        label=made_of.label,
        normals=_about_y(out, turn).astype(np.float32),
    )


def _about_y(pairs: F64, turn: F64) -> F64:
    """Turn (radius, y) [N, 2] into [N T, 3]."""
    x, z = (pairs[:, :1] * trig[None] for trig in (np.sin(turn), np.cos(turn)))
    y = np.broadcast_to(pairs[:, 1:], x.shape)
    return np.stack([x, y, z], axis=2).reshape(-1, 3)


def _spokes(radius_m: float, width_m: float, count: int) -> Mesh:
    """Return bars from hub to rim, each with a face and two flanks."""
    half = 0.055 * radius_m * 10 / max(count, 6)
    inner, outer = (HUB_RADIUS - 0.02) * radius_m, RIM_RADIUS * radius_m
    hub_y, rim_y, back_y = SPOKE_OUT[0] * width_m, SPOKE_OUT[1] * width_m, 0.12 * width_m
    face = [(inner, hub_y, 1.25), (inner, hub_y, -1.25), (outer, rim_y, -0.8), (outer, rim_y, 0.8)]
    sides = []
    for sign in (1.0, -1.0):
        near, far = 1.25 * sign, 0.8 * sign
        flank = [(inner, hub_y, near), (outer, rim_y, far), (outer, back_y, far)]
        flank.append((inner, back_y, near))
        sides.append(flank if sign > 0 else flank[::-1])
    bar = np.array([face, *sides]) * (1.0, 1.0, half)
    turn = 2 * np.pi * np.arange(count) / count
    x = (
        bar[None, ..., 0] * np.cos(turn)[:, None, None]
        - bar[None, ..., 2] * np.sin(turn)[:, None, None]
    )
    z = (
        bar[None, ..., 0] * np.sin(turn)[:, None, None]
        + bar[None, ..., 2] * np.cos(turn)[:, None, None]
    )
    y = np.broadcast_to(bar[None, ..., 1], x.shape)
    return quads(RIM, np.stack([x, y, z], axis=-1).reshape(-1, 4, 3))


TRUCK_LENGTH_M = 7.0
TRUCK_REAR_AXLE_M = 5.35
KINDS = ("hatchback", "saloon", "estate", "suv", "van", "truck")
SHARES = (0.34, 0.20, 0.16, 0.18, 0.09, 0.03)
"""The share of each kind in a European street."""
PAINT_SHARES = (0.19, 0.17, 0.21, 0.17, 0.08, 0.05, 0.06, 0.03, 0.02, 0.02)
WHEEL_INSET_M = 0.035


@dataclass(frozen=True)
class VehicleLooks:
    """A vehicle's kind (of ``KINDS``), paint, number plate, wheels and, on a truck, its firm."""

    kind: str
    paint: str
    plate: int = 0
    livery: int = 0
    spokes: int = 7

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> VehicleLooks:
        """Return a vehicle by chance, kinds and paints as common as in a street."""
        kind = KINDS[int(rng.choice(len(KINDS), p=SHARES))]
        paint = tuple(PAINTS)[int(rng.choice(len(PAINTS), p=PAINT_SHARES))]
        plate, livery, spokes = (int(rng.integers(n)) for n in (len(PLATES), len(LIVERIES), 4))
        return cls(kind, paint, plate, livery, 5 + 2 * spokes)

    @property
    def length_m(self) -> float:
        """Length from nose to tail."""
        return TRUCK_LENGTH_M if self.kind == "truck" else BODIES[self.kind].length_m


def vehicle(looks: VehicleLooks) -> list[Mesh]:
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


def _wheels(looks: VehicleLooks, shape: BodyShape) -> list[Mesh]:
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
