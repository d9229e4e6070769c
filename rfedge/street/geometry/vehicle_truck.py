"""The box of a delivery truck: walls with the name of a firm, doors, frame and guards."""

from __future__ import annotations

import numpy as np

from rfedge.street.geometry.lettering import atlas_uv
from rfedge.street.geometry.mesh import Label, Mesh
from rfedge.street.geometry.solids import Stuff, boxes, quads, tube
from rfedge.street.geometry.vehicle_material import LIVERIES
from rfedge.street.geometry.vehicle_trim import number_plate

__all__ = ["BOX_HIGH_M", "BOX_LOW_M", "cargo"]

WALL = Stuff("livery", Label.VEHICLE)
EDGE = Stuff("car chrome", Label.VEHICLE)
DARK = Stuff("car trim", Label.VEHICLE)
LAMP = Stuff("car tail lamp", Label.VEHICLE)
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
    meshes += [quads(WALL, [roof], plain[None]), quads(DARK, [floor])]
    return [*meshes, *_edges(front_m, rear_m), *_below(front_m, rear_m), *_tail(rear_m, plate)]


def _wall(start: tuple[float, float], end: tuple[float, float], uv: np.ndarray) -> Mesh:
    """An upright rectangle; from outside ``start`` is on its right."""
    (x0, y0), (x1, y1) = end, start
    low, high = BOX_LOW_M, BOX_HIGH_M
    return quads(WALL, [[(x1, y1, low), (x0, y0, low), (x0, y0, high), (x1, y1, high)]], uv[None])


def _paper_uv(livery: int) -> np.ndarray:
    """A corner of the firm's board, where there is no letter."""
    uv = atlas_uv(len(LIVERIES), livery)
    return np.asarray(uv[:1] + (uv[2] - uv[0]) * 0.02 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))


def _edges(front_m: float, rear_m: float) -> list[Mesh]:
    """Rails of metal along all edges of the box."""
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
    """The frame, a tank, and the guards along the sides."""
    frame = [
        boxes(DARK, (rear_m + 0.1, y - 0.06, 0.72), (front_m + 0.4, y + 0.06, 1.0))
        for y in (0.42, -0.42)
    ]
    length = front_m - rear_m
    tank = boxes(DARK, (front_m - 0.34 * length, 0.62, 0.42), (front_m - 0.12 * length, 1.08, 0.9))
    guards = [
        tube(DARK, [(front_m - 0.1, y, z), (rear_m + 0.42 * length, y, z)], 0.025, 6)
        for y in (1.12, -1.12)
        for z in (0.5, 0.78)
    ]
    return [*frame, tank, *guards]


def _tail(rear_m: float, plate: int) -> list[Mesh]:
    """Underrun bar, lamps, the door's gap and its locking bars, number plate."""
    y = HALF_WIDTH_M
    bar = boxes(DARK, (rear_m + 0.02, -y, 0.45), (rear_m + 0.1, y, 0.60))
    holder = boxes(DARK, (rear_m + 0.04, -0.6, 0.55), (rear_m + 0.1, 0.6, 1.0))
    lamps = [
        boxes(LAMP, (rear_m - 0.02, s * 0.93 - 0.16, 0.72), (rear_m + 0.05, s * 0.93 + 0.16, 0.88))
        for s in (1, -1)
    ]
    bars = [
        tube(EDGE, [(rear_m - 0.03, s, 1.05), (rear_m - 0.03, s, 3.2)], 0.016, 6)
        for s in (-0.75, -0.2, 0.2, 0.75)
    ]
    gap = boxes(DARK, (rear_m - 0.008, -0.008, 1.05), (rear_m, 0.008, 3.2))
    return [
        bar,
        holder,
        *lamps,
        *bars,
        gap,
        number_plate(np.array([rear_m + 0.01, 0, 0.72]), -1.0, plate),
    ]
