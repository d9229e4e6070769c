"""Where things stand that one picture shows and the field does not have.

A pixel is *marked* when it belongs to a change (``rfcore.native.live_view``) and differs by more
than ``THING_LEVELS`` itself. The lowest pixel of a run of marked ones in a column is a *contact*
with the ground when

* the field's surface just below it is level ground (z is up) within ``REACH_M``,
* of the ``LOOKED_AT_M`` above it at least ``LEAST_MARKED_M`` are marked, at its distance: a thing
  may look like what is behind it in the middle, and paint on the road is not tall, and
* it is not within ``TALL_M`` above another contact of its column, for then it belongs to that.

Left out thereby is mostly the field's own error, at the edges of facades, trees and roofs.

A contact is as far away as the ray through it meets the ground: a plane, fitted to what the picture
shows of the ground nearby, since a field's depth of the road is too short at a grazing angle (by
1.7 of 17 m on the sample's field). Where the field's surface is not near it, its depth counts.

Contacts of neighbouring columns that are near each other on the ground are one thing. One longer
than ``LONG_M`` is taken for a row of parked vehicles, whose gaps cannot be seen from afar, and cut
every ``PIECE_M`` along the axis of the world in which it is longer: the cuts stay where they are
from one picture to the next. A thing stands where the middle of its near side is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mec_server.twin.composition import LivePicture
from rfcore.camera import Camera

__all__ = ["Detection", "detect"]

THING_LEVELS = 30.0
"""On the sample's empty drive one picture in 12 has a contact at all."""
BELOW_PX, GROUND_PX = 2, 6
"""How far below a contact the ground is looked at, and how much further its slope."""
MOST_SLOPE = 0.4
"""Sine of the steepest way from there to the contact."""
REACH_M = 32.0
LOOKED_AT_M, LEAST_MARKED_M = 1.5, 0.3
TALL_M = 2.2

PLANE_REACH_M, PLANE_STEP_PX, PLANE_ROUNDS = 10.0, 6, 5
LEAST_PLANE_POINTS = 30
LEVEL_GROUND = 0.15
NEAR_PLANE_M = 0.4

LINK_PX, LINK_M, LINK_PER_M = 6, 0.3, 0.04
LONG_M, PIECE_M = 5.5, 4.5
LEAST_PX, LEAST_COLUMNS, LEAST_WIDTH_M = 200, 4, 0.15
NEAR_SHARE, SAME_SIDE = 0.1, 1.1
"""The near side: the nearest tenth of a thing's contacts, and those up to so many times as far."""

Vec3 = tuple[float, float, float]
F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Detection:
    """A thing in one picture: its foot relative to the tile's origin, ``distance_m`` from the
    camera, and its size as the camera sees it."""

    at_m: Vec3
    distance_m: float
    width_m: float
    height_m: float


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of one picture, by column, lowest first: rows and columns [N], ``z_m`` [N] along the
    optical axis, ``marked_m`` [N] how much is marked above, ``at_m`` [N, 3] in the world."""

    rows: Index
    columns: Index
    z_m: F64
    marked_m: F64
    at_m: F64

    def __getitem__(self, chosen: Index | Mask) -> Contacts:
        return Contacts(
            self.rows[chosen],
            self.columns[chosen],
            self.z_m[chosen],
            self.marked_m[chosen],
            self.at_m[chosen],
        )


def detect(picture: LivePicture) -> list[Detection]:
    """Return what ``picture`` shows that the field does not have, from left to right."""
    if picture.trust == 0:
        return []
    contacts = _contacts(picture)
    found = []
    for thing in _things(contacts):
        detection = _standing(contacts[thing], picture.camera)
        if detection is not None:
            found.append(detection)
    return found


def _contacts(picture: LivePicture) -> Contacts:
    marked = picture.changed & (np.abs(picture.difference).max(axis=2) > THING_LEVELS)
    rows, columns = _feet(marked)
    camera, depth = picture.camera, picture.depth
    below_m = depth[rows + BELOW_PX, columns].astype(np.float64)
    surface_m = _world(camera, rows + BELOW_PX, columns, below_m)
    level = _is_level(picture, rows, columns, surface_m) & (below_m > 0)
    z_m = _ground_z_m(picture, rows, columns, surface_m, below_m)
    height_m = _marked_m(marked, rows, columns, z_m, camera.intrinsics.fy_px)
    at_m = _world(camera, rows, columns, z_m)
    good = level & (z_m > 0) & (z_m <= REACH_M) & (height_m >= LEAST_MARKED_M)
    contacts = Contacts(rows, columns, z_m, height_m, at_m)[good]
    ordered = contacts[np.lexsort((-contacts.rows, contacts.columns))]
    return ordered[_not_above_another(ordered, camera.intrinsics.fy_px)]


def _feet(marked: Mask) -> tuple[Index, Index]:
    """Return rows and columns of marked pixels with BELOW_PX unmarked ones below them."""
    feet = marked.copy()
    for px in range(1, BELOW_PX + 1):
        feet[:-px] &= ~marked[px:]
    feet[-BELOW_PX - 1 :] = False
    rows, columns = np.nonzero(feet)
    return rows, columns


def _world(camera: Camera, rows: Index, columns: Index, z_m: F64) -> F64:
    """Return the points [N, 3] that pixels show at depths, relative to the tile's origin."""
    pose = camera.world_from_cam
    rays = _rays(camera, rows, columns)
    return np.asarray(rays * z_m[:, None] + np.array(pose.translation_m))


def _rays(camera: Camera, rows: Index, columns: Index) -> F64:
    """Return directions of pixel centres in the world [N, 3], 1 long along the optical axis."""
    k = camera.intrinsics
    across, down = (columns + 0.5 - k.cx_px) / k.fx_px, (rows + 0.5 - k.cy_px) / k.fy_px
    turn = np.array(camera.world_from_cam.rotation_matrix())
    return np.asarray(np.stack([across, down, np.ones(len(rows))], axis=1) @ turn.T)


def _is_level(picture: LivePicture, rows: Index, columns: Index, surface_m: F64) -> Mask:
    """Return whether the way from further below to the surface below a contact is level."""
    further = np.minimum(rows + GROUND_PX, picture.depth.shape[0] - 1)
    z_m = picture.depth[further, columns].astype(np.float64)
    before_m = _world(picture.camera, further, columns, z_m)
    length_m = np.linalg.norm(surface_m - before_m, axis=1)
    climb_m = np.abs(surface_m[:, 2] - before_m[:, 2])
    return np.asarray((z_m > 0) & (length_m > 1e-3) & (climb_m <= MOST_SLOPE * length_m))


def _ground_z_m(
    picture: LivePicture, rows: Index, columns: Index, surface_m: F64, below_m: F64
) -> F64:
    """Return depths of contacts: of the ground's plane where the field is near it."""
    plane = _ground_plane(picture)
    if plane is None:
        return below_m
    eye_m = np.array(picture.camera.world_from_cam.translation_m)
    rays = _rays(picture.camera, rows, columns)
    falls = rays[:, 2] - rays[:, :2] @ plane[1:]
    along_m = np.where(falls < -1e-6, (plane[0] - eye_m[2]) / np.minimum(falls, -1e-6), np.inf)
    height_m = surface_m[:, 2] - (plane[0] + (surface_m[:, :2] - eye_m[:2]) @ plane[1:])
    near = (np.abs(height_m) < NEAR_PLANE_M) & np.isfinite(along_m)
    return np.asarray(np.where(near, along_m, below_m))


def _ground_plane(picture: LivePicture) -> F64 | None:
    """Return height under the camera and slopes along x and y of the ground, ``None`` if the
    picture shows too little of it: weighted least squares, from which outliers are dropped."""
    eye_m = np.array(picture.camera.world_from_cam.translation_m)
    points_m = _ground_points(picture, eye_m)
    if len(points_m) < LEAST_PLANE_POINTS:
        return None
    terms = np.column_stack([np.ones(len(points_m)), points_m[:, :2] - eye_m[:2]])
    weight = 1 / np.maximum(np.linalg.norm(points_m - eye_m, axis=1), 1.0)
    inside = np.abs(points_m[:, 2] - np.median(points_m[:, 2])) < 0.5
    plane = np.zeros(3)
    for _ in range(PLANE_ROUNDS):
        sides = terms[inside] * weight[inside, None], points_m[inside, 2] * weight[inside]
        plane = np.linalg.lstsq(*sides, rcond=None)[0]
        error_m = np.abs(terms @ plane - points_m[:, 2])
        inside = error_m <= max(2 * float(np.median(error_m[inside])), 0.02)
    return plane


def _ground_points(picture: LivePicture, eye_m: F64) -> F64:
    """Return points [N, 3] of unchanged level ground below the camera."""
    height, width = picture.depth.shape
    step, ahead = PLANE_STEP_PX, GROUND_PX - BELOW_PX
    grid = np.mgrid[step : height - ahead : step, step:width:step]
    rows, columns = grid[0].ravel(), grid[1].ravel()
    z_m = picture.depth[rows, columns].astype(np.float64)
    good = (z_m > 0) & (z_m < PLANE_REACH_M) & ~picture.changed[rows, columns]
    rows, columns, z_m = rows[good], columns[good], z_m[good]
    below_m = picture.depth[rows + ahead, columns].astype(np.float64)
    points_m = _world(picture.camera, rows, columns, z_m)
    before_m = _world(picture.camera, rows + ahead, columns, below_m)
    way_m = np.linalg.norm(points_m - before_m, axis=1)
    level = np.abs(points_m[:, 2] - before_m[:, 2]) < LEVEL_GROUND * way_m
    good = level & (below_m > 0) & (points_m[:, 2] < eye_m[2] - 0.5)
    return np.asarray(points_m[good])


def _marked_m(marked: Mask, rows: Index, columns: Index, z_m: F64, focal_px: float) -> F64:
    """Return how much is marked within LOOKED_AT_M above contacts, metres [N]."""
    counted = np.zeros((marked.shape[0] + 1, marked.shape[1]), np.int32)
    np.cumsum(marked, axis=0, out=counted[1:])
    px_per_m = focal_px / np.maximum(z_m, 0.1)
    top = np.maximum(0, rows + 1 - (LOOKED_AT_M * px_per_m).astype(np.intp))
    return np.asarray((counted[rows + 1, columns] - counted[top, columns]) / px_per_m)


def _not_above_another(contacts: Contacts, focal_px: float) -> Mask:
    """Return which contacts stand on the ground by themselves."""
    own = np.ones(len(contacts.rows), bool)
    above_px = TALL_M * focal_px / np.maximum(contacts.z_m, 0.1)
    column, top = -1, 0.0
    for i, (row, at) in enumerate(zip(contacts.rows, contacts.columns, strict=True)):
        if at == column and row > top:
            own[i] = False
        else:
            column, top = at, row - above_px[i]
    return own


def _things(contacts: Contacts) -> Iterator[Index]:
    """Yield which contacts belong to each thing, from left to right."""
    numbers = _linked(contacts)
    for number in dict.fromkeys(numbers.tolist()):
        members = np.flatnonzero(numbers == number)
        at_m = contacts.at_m[members, :2]
        lengths_m = np.ptp(at_m, axis=0)
        axis = int(lengths_m[1] > lengths_m[0])
        if lengths_m[axis] <= LONG_M:
            yield members
            continue
        pieces = np.floor(at_m[:, axis] / PIECE_M)
        for piece in dict.fromkeys(pieces.tolist()):
            yield members[pieces == piece]


def _linked(contacts: Contacts) -> Index:
    """Return a number for each contact, the same for those of one thing."""
    numbers = np.arange(len(contacts.rows))
    reach_m = LINK_M + LINK_PER_M * contacts.z_m
    first = 0
    for i, column in enumerate(contacts.columns):
        while column - contacts.columns[first] > LINK_PX:
            first += 1
        away_m = np.linalg.norm(contacts.at_m[first:i, :2] - contacts.at_m[i, :2], axis=1)
        for other in dict.fromkeys(numbers[first:i][away_m <= reach_m[i]].tolist()):
            low, high = sorted((int(numbers[i]), other))
            numbers[numbers == high] = low
    return numbers


def _standing(thing: Contacts, camera: Camera) -> Detection | None:
    """Return where a thing stands, ``None`` for one that is too small to be one."""
    k, z_m = camera.intrinsics, float(np.median(thing.z_m))
    width_m = float(np.ptp(thing.columns) + 1) * z_m / k.fx_px
    marked_px = float((thing.marked_m * k.fy_px / thing.z_m).sum())
    narrow = len(np.unique(thing.columns)) < LEAST_COLUMNS or width_m < LEAST_WIDTH_M
    if narrow or marked_px < LEAST_PX:
        return None
    near = np.flatnonzero(thing.z_m <= SAME_SIDE * np.quantile(thing.z_m, NEAR_SHARE))
    middle = (thing.columns[near].min() + thing.columns[near].max()) / 2
    foot = near[np.argmin(np.abs(thing.columns[near] - middle))]
    x_m, y_m, up_m = (float(value) for value in thing.at_m[foot])
    at_m = (x_m, y_m, up_m)
    distance_m = math.dist(at_m, camera.world_from_cam.translation_m)
    return Detection(at_m, distance_m, width_m, float(np.median(thing.marked_m)))
