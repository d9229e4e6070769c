"""Detection of objects that one picture shows and the field lacks, by their contacts with the
ground.

A pixel is *marked* when it belongs to a change (``rfcore.native.live_view``) and itself differs by
more than ``THING_LEVELS``, times the field's ``brightness``. The lowest pixel of a run of marked
ones in a column is a *contact* with the ground when

* the field's surface just below it is level ground within ``REACH_M``,
* of the ``LOOKED_AT_M`` above it at least ``LEAST_MARKED_M`` are marked, at its distance: a thing
  may look like what is behind it in the middle, and paint on the road is not tall, and
* it is not within ``TALL_M`` above something else of its column that is marked so far up, for then
  it belongs to that, whether that stands on level ground or not, nor above what is marked at the
  picture's lower edge, whose foot is outside of the picture.

This leaves out most of the field's own errors, at the edges of facades, trees and roofs.

An object also changes the ground before it, by its shadow: all colours are darkened alike, to
``SHADOW`` of the field's, within ``SHADOW_TINT`` of each other. (Under a vehicle it is darker than
that.) A contact in a shadow is moved up to the shadow's end, if that is no more than ``SHADOW_M``
of ground further away.

A contact is as far away as the ray through it meets the ground (``rfcore.perception.ground``).
Where the field's surface is not near that, its depth counts.

Contacts of neighbouring columns that are near each other on the ground belong to one object. One
longer than ``LONG_M`` is taken for a row of parked vehicles, whose gaps cannot be seen from afar,
and cut every ``PIECE_M`` along the axis of the world in which it is longer: the cuts stay where
they are from one picture to the next. The position of an object is the middle of its near side.

Its uncertainty across the view is ``ACROSS_PX`` and ``SIDE_M``, since the visible side changes with
the view; along the view it is the length of ``CONTACT_PX`` of ground, which grows with the square
of the distance over the camera's height. A near side that the picture's edge cuts off is uncertain
by ``CUT_M``.

All of this is done in the field's upright frame (``rfcore.vertical``); detections are told in the
field's own axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Vec3
from rfcore.perception.composition import LivePicture, Outline, with_things
from rfcore.perception.ground import FieldGround, GroundPlane, points_of, rays_of
from rfcore.vertical import Z_UP

THING_LEVELS = 22.0
"""On the sample's empty drive nothing is found, nor with 18. With 30, 86 % of the vehicles of
another drive are found instead of 88 %, and a hole in a van counts as another object."""
BELOW_PX, GROUND_PX = 2, 6
"""Rows below a contact at which the ground is sampled, and further rows for its slope."""
MOST_SLOPE = 0.4
"""Sine of the steepest way from there to the contact."""
SHADOW, SHADOW_TINT, SHADOW_M, BORDER_PX = (0.4, 0.9), 0.12, 2.0, 3
"""On the sample's drive among vehicles, and on two other arrangements of them, the 95th percentile
of the position error falls from 1.35, 1.5 and 1.0 m to 0.75, 1.3 and 0.9 m."""
REACH_M = 32.0
LOOKED_AT_M, LEAST_MARKED_M = 1.5, 0.3
TALL_M = 2.2
OUTLINE_M = 2.6
"""Height above the foot that an object's outline may have: a van is that tall."""
NEAR_GROUND_M = 0.4

LINK_PX, LINK_M, LINK_PER_M = 6, 0.3, 0.04
LONG_M, PIECE_M = 5.5, 4.5
LEAST_PX, LEAST_COLUMNS, LEAST_WIDTH_M = 200, 4, 0.4
"""Narrower detections are mostly pieces of a vehicle between others: with 0.15 m two more objects
are false in 2.4 s, and not one more vehicle is found."""
NEAR_SHARE, SAME_SIDE = 0.1, 1.1
"""The near side is the nearest tenth of an object's contacts, and those up to this factor
further."""
MIDDLE_SHARE = 0.5
CONTACT_PX, ACROSS_PX, SIDE_M, CUT_M = 1.0, 2.0, 0.25, 1.5
LEAST_EYE_M = 0.5
"""Least height of a camera above the foot."""

F64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Detection:
    """An object in one picture.

    ``at_m``: its foot, relative to the tile's origin; ``eye_m``: the camera; ``width_m`` and
    ``height_m``: its size as the camera sees it; ``marked_px``: its marked pixels. The sigmas are
    those of its foot on the ground, along the view and across it. ``trust``: that of the picture
    (``LivePicture``). ``up``: the field's vertical.
    """

    at_m: Vec3
    eye_m: Vec3
    width_m: float
    height_m: float
    marked_px: int
    along_sigma_m: float
    across_sigma_m: float
    trust: float = 1.0
    up: Vec3 = Z_UP

    @property
    def distance_m(self) -> float:
        """Distance of its foot from the camera."""
        return math.dist(self.at_m, self.eye_m)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of one picture, by column, lowest first.

    Rows and columns [N]; ``z_m`` [N]: depth along the optical axis; ``marked_m`` [N]: marked length
    above; ``at_m`` [N, 3]: position in the world.
    """

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


@dataclass(frozen=True, eq=False)
class OutlinedDetection:
    """A detection and its outline in the picture."""

    detection: Detection
    outline: Outline


def find(picture: LivePicture, ground: FieldGround) -> list[OutlinedDetection]:
    """Return the objects in ``picture`` that the field lacks, from left to right; ``ground`` is
    that field's."""
    if picture.trust == 0:
        return []
    upright = replace(picture, camera=ground.upright(picture.camera))
    contacts = _contacts(upright, ground)
    found = []
    for thing in _things(contacts):
        standing = _standing(contacts[thing], upright)
        if standing is not None:
            at_m, eye_m = (
                ground.in_field(standing.at_m),
                picture.camera.world_from_cam.translation_m,
            )
            detection = replace(standing, at_m=at_m, eye_m=eye_m, up=ground.up)
            outline = _outline(picture, contacts[thing], detection)
            found.append(OutlinedDetection(detection, outline))
    return found


def detect(picture: LivePicture, ground: FieldGround) -> list[Detection]:
    """Return the detections without outlines."""
    return [each.detection for each in find(picture, ground)]


def cut_out(picture: LivePicture, ground: FieldGround) -> tuple[LivePicture, list[Detection]]:
    """Return ``picture`` with its objects as patches (``with_things``), and their detections."""
    found = find(picture, ground)
    things = with_things(picture, [each.outline for each in found])
    return things, [each.detection for each in found]


def _outline(picture: LivePicture, thing: Contacts, detection: Detection) -> Outline:
    """Return the region between the contacts of an object and the uppermost change above each.

    Between columns with contacts, feet and tops lie on straight lines.
    """
    z_m = float(np.median(thing.z_m))
    tall_px = math.ceil(OUTLINE_M * picture.camera.intrinsics.fy_px / z_m)
    columns, firsts = np.unique(thing.columns, return_index=True)  # the lowest contact of each
    feet = thing.rows[firsts]
    rows_above = np.maximum(feet - np.arange(tall_px, -1, -1)[:, None], 0)
    tops = rows_above[np.argmax(picture.changed[rows_above, columns], axis=0), range(len(columns))]
    across = np.arange(columns[0], columns[-1] + 1)
    foot, top = (np.rint(np.interp(across, columns, ends)) for ends in (feet, tops))
    rows = slice(int(top.min()), int(foot.max()) + 1)
    row = np.arange(rows.start, rows.stop)[:, None]
    mask = (row >= top) & (row <= foot)
    box = (rows, slice(int(columns[0]), int(columns[-1]) + 1))
    return Outline(box, mask, z_m, detection.at_m)


def _contacts(picture: LivePicture, ground: FieldGround) -> Contacts:
    red, green, blue = (np.abs(picture.difference[..., channel]) for channel in range(3))
    least_levels = picture.brightness * THING_LEVELS
    marked = picture.changed & (np.maximum(np.maximum(red, green), blue) > least_levels)
    rows, columns = _feet(marked)
    camera, depth = picture.camera, picture.depth
    below_m = depth[rows + BELOW_PX, columns].astype(np.float64)
    surface_m = points_of(camera, rows + BELOW_PX, columns, below_m)
    level = _is_level(picture, rows, columns, surface_m)
    place = partial(_ground_z_m, camera, ground.ahead_of(camera) if len(rows) else None)
    z_m = place(rows, columns, surface_m, below_m)
    height_m = _marked_m(marked, rows, columns, z_m, camera.intrinsics.fy_px)
    above = _above_shadow(picture, marked, rows, columns)
    above_m = place(above, columns, surface_m, below_m)
    shadow = (above_m > z_m) & (above_m - z_m <= SHADOW_M)
    rows, z_m = np.where(shadow, above, rows), np.where(shadow, above_m, z_m)
    at_m = points_of(camera, rows, columns, z_m)
    tall = (below_m > 0) & (z_m > 0) & (z_m <= REACH_M) & (height_m >= LEAST_MARKED_M)
    order = np.flatnonzero(tall)
    order = order[np.lexsort((-rows[order], columns[order]))]
    feet = Contacts(rows, columns, z_m, height_m, at_m)[order]
    free_above = _free_above(marked, depth[-1], camera.intrinsics.fy_px)
    own = _not_above_another(feet, camera.intrinsics.fy_px, free_above)
    return feet[own & level[order]]


def _feet(marked: Mask) -> tuple[Index, Index]:
    """Return rows and columns of marked pixels with BELOW_PX unmarked ones below them."""
    feet = marked.copy()
    for px in range(1, BELOW_PX + 1):
        feet[:-px] &= ~marked[px:]
    feet[-BELOW_PX - 1 :] = False
    rows, columns = np.nonzero(feet)
    return rows, columns


def _above_shadow(picture: LivePicture, marked: Mask, rows: Index, columns: Index) -> Index:
    """Return the row of each contact or, where that is in a shadow, of the lowest marked pixel
    above the shadow [N]; between both at most ``BORDER_PX`` are unmarked."""
    height = len(marked)
    level = (picture.colour * np.float32(255)).clip(1, 255)
    left = (level + picture.difference) / level
    red, green, blue = (left[..., channel] for channel in range(3))
    least = np.minimum(np.minimum(red, green), blue)  # min(axis=2) takes 20 times as long
    most = np.maximum(np.maximum(red, green), blue)
    shadow = (least >= SHADOW[0]) & (most <= SHADOW[1]) & (most - least <= SHADOW_TINT)
    row = np.arange(height)[:, None]
    solid = np.maximum.accumulate(np.where(marked & ~shadow, row, -1), axis=0)
    above = solid[rows, columns]
    unmarked = np.zeros((height + 1, marked.shape[1]), np.int32)
    np.cumsum(~marked, axis=0, out=unmarked[1:])
    between = unmarked[rows + 1, columns] - unmarked[above, columns]
    return np.asarray(np.where((above >= 0) & (between <= BORDER_PX), above, rows))


def _is_level(picture: LivePicture, rows: Index, columns: Index, surface_m: F64) -> Mask:
    """Return whether the ground between two rows below a contact is level."""
    further = np.minimum(rows + GROUND_PX, picture.depth.shape[0] - 1)
    z_m = picture.depth[further, columns].astype(np.float64)
    before_m = points_of(picture.camera, further, columns, z_m)
    length_m = np.linalg.norm(surface_m - before_m, axis=1)
    climb_m = np.abs(surface_m[:, 2] - before_m[:, 2])
    return np.asarray((z_m > 0) & (length_m > 1e-3) & (climb_m <= MOST_SLOPE * length_m))


def _ground_z_m(
    camera: Camera,
    plane: GroundPlane | None,
    rows: Index,
    columns: Index,
    surface_m: F64,
    below_m: F64,
) -> F64:
    """Return depths of contacts: of the ground's ``plane`` where the field's surface is near it."""
    if plane is None:
        return below_m
    along_m = plane.depths_m(camera.world_from_cam.translation_m, rays_of(camera, rows, columns))
    off_m = np.abs(surface_m[:, 2] - plane.heights_m(surface_m[:, :2]))
    return np.asarray(np.where((off_m < NEAR_GROUND_M) & np.isfinite(along_m), along_m, below_m))


def _marked_m(marked: Mask, rows: Index, columns: Index, z_m: F64, focal_px: float) -> F64:
    """Return the marked length within LOOKED_AT_M above contacts, metres [N]."""
    counted = np.zeros((marked.shape[0] + 1, marked.shape[1]), np.int32)
    np.cumsum(marked, axis=0, out=counted[1:])
    px_per_m = focal_px / np.maximum(z_m, 0.1)
    top = np.maximum(0, rows + 1 - (LOOKED_AT_M * px_per_m).astype(np.intp))
    return np.asarray((counted[rows + 1, columns] - counted[top, columns]) / px_per_m)


def _free_above(marked: Mask, edge_m: NDArray[np.float32], focal_px: float) -> Index:
    """Return, for each column, the row above which an object at the picture's lower edge ends.

    That is the number of rows where there is none. ``edge_m``: depths of the lowest row.
    """
    height = len(marked)
    px_per_m = focal_px / np.maximum(edge_m.astype(np.float64), 0.1)
    free_above = np.full(marked.shape[1], height)
    for column in np.flatnonzero(marked[-1] & (edge_m > 0)):
        looked_at = max(0, height - int(LOOKED_AT_M * px_per_m[column]))
        if marked[looked_at:, column].sum() >= LEAST_MARKED_M * px_per_m[column]:
            free_above[column] = height - TALL_M * px_per_m[column]
    return free_above


def _not_above_another(contacts: Contacts, focal_px: float, free_above: Index) -> Mask:
    """Return which contacts stand on the ground by themselves."""
    own = np.ones(len(contacts.rows), bool)
    above_px = TALL_M * focal_px / np.maximum(contacts.z_m, 0.1)
    column, top = -1, 0.0
    each = zip(contacts.rows.tolist(), contacts.columns.tolist(), above_px.tolist(), strict=True)
    for i, (row, at, tall_px) in enumerate(each):
        if at != column:
            column, top = at, float(free_above[at])
        if row > top:
            own[i] = False
        else:
            top = row - tall_px
    return own


def _things(contacts: Contacts) -> Iterator[Index]:
    """Yield the contacts of each object, from left to right."""
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
    """Return a number for each contact, the same for those of one object: that of its first."""
    count = len(contacts.rows)
    numbers = np.arange(count)
    firsts = np.searchsorted(contacts.columns, contacts.columns - LINK_PX)
    befores = numbers - firsts
    later = np.repeat(numbers, befores)
    earlier = np.arange(len(later)) - np.repeat(np.cumsum(befores) - befores - firsts, befores)
    away_m = np.linalg.norm(contacts.at_m[later, :2] - contacts.at_m[earlier, :2], axis=1)
    near = away_m <= LINK_M + LINK_PER_M * contacts.z_m[later]
    later, earlier = later[near], earlier[near]
    while True:
        before = numbers.copy()
        lowest = np.minimum(numbers[later], numbers[earlier])
        for ends in (later, earlier):
            np.minimum.at(numbers, numbers[ends], lowest)
            np.minimum.at(numbers, ends, lowest)
        numbers = numbers[numbers]
        if np.array_equal(numbers, before):
            return numbers


def _standing(thing: Contacts, picture: LivePicture) -> Detection | None:
    """Return an object's position and size, None for one that is too small."""
    if len(np.unique(thing.columns)) < LEAST_COLUMNS:
        return None
    camera = picture.camera
    k, z_m = camera.intrinsics, float(np.median(thing.z_m))
    width_m = float(np.ptp(thing.columns) + 1) * z_m / k.fx_px
    marked_px = float((thing.marked_m * k.fy_px / thing.z_m).sum())
    if width_m < LEAST_WIDTH_M or marked_px < LEAST_PX:
        return None
    near = np.flatnonzero(thing.z_m <= SAME_SIDE * np.quantile(thing.z_m, NEAR_SHARE))
    middle = (thing.columns[near].min() + thing.columns[near].max()) / 2
    foot = near[_nearest_to(middle, thing.columns[near])]
    x_m, y_m, up_m = (float(value) for value in thing.at_m[foot].mean(axis=0))
    eye_m = camera.world_from_cam.translation_m
    on_ground_m = math.hypot(x_m - eye_m[0], y_m - eye_m[1])
    px_m = on_ground_m**2 / (max(eye_m[2] - up_m, LEAST_EYE_M) * k.fy_px)
    edges = thing.columns[near].min() == 0 or thing.columns[near].max() == k.width_px - 1
    unknown_m = CUT_M if edges else SIDE_M
    return Detection(
        (x_m, y_m, up_m),
        eye_m,
        width_m,
        float(np.median(thing.marked_m)),
        round(marked_px),
        math.hypot(CONTACT_PX * px_m, unknown_m),
        math.hypot(ACROSS_PX * on_ground_m / k.fx_px, unknown_m),
        picture.trust,
    )


def _nearest_to(middle: float, columns: Index) -> Index:
    """Return the ``MIDDLE_SHARE`` of columns that are nearest to ``middle``: the mean of many
    contacts is more certain than a single one."""
    count = max(1, round(MIDDLE_SHARE * len(columns)))
    return np.argsort(np.abs(columns - middle), kind="stable")[:count]
