"""Objects as textured patches that stand in the street at their own depth.

The pixels of an object that the field lacks (``rfcore.perception.contacts``) are cut out of the
picture and stand upright where the object meets the ground, parallel to the picture's plane: from
another viewpoint they move before the background. Without patches these pixels would be carried as
if painted on the surface behind; and that surface is hidden from the camera, which vouches for
nothing there.

A patch is drawn where no surface of the field and no other patch is nearer, and only from ahead of
it rather than from aside (``LEAST_COSINE`` between the rays of the two cameras to its middle). Of
several pictures' patches of one object, with feet within ``SAME_M``, the one of the largest weight
is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose, Vec3
from rfcore.native.live_view import (
    ABSOLUTE_DEPTH_M,
    COVERED,
    LEAST_COSINE,
    MOST_DISTANCE_M,
    NEAREST_M,
    RELATIVE_DEPTH,
    Canvas,
    Patch,
    draw_patch,
)
from rfcore.raster.gaussians import F32
from rfcore.views import View

SAME_M = 1.5

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StandingPatch:
    """A patch of an object whose foot is at ``foot_m``, in the field's axes.

    ``source``: the number of its picture; ``weight``: the picture's weight; ``fade``: 0 to 1, how
    much of it remains visible.
    """

    patch: Patch
    foot_m: Vec3
    source: int = 0
    weight: float = 1.0
    fade: float = 1.0


@dataclass(frozen=True, eq=False)
class _PatchInView:
    """A patch in rows and columns ``box`` of a view; ``from_view`` maps points of the view's axes
    into those of the patch's camera."""

    thing: StandingPatch
    from_view: Pose
    box: tuple[slice, slice]
    distance_m: float


def in_front_of(view: View) -> F32:
    """Return the depth up to which an object hides the surfaces of ``view``, float32 [H, W]."""
    reach = view.depth * np.float32(1 + RELATIVE_DEPTH) + np.float32(ABSOLUTE_DEPTH_M)
    return np.where(view.opacity > COVERED, reach, np.float32(np.inf))


def draw_standing(canvas: Canvas, things: Iterable[StandingPatch]) -> None:
    """Draw the patches that are visible in the view of ``canvas``, the furthest first."""
    world_from_view = canvas.camera.world_from_cam
    motions: dict[int, Pose] = {}
    seen: list[_PatchInView] = []
    for each in _once(things):
        if each.source not in motions:
            motions[each.source] = each.patch.camera.cam_from_world().compose(world_from_view)
        found = _place_in(canvas.camera, each, motions[each.source])
        seen += [] if found is None else [found]
    for one in sorted(seen, key=lambda it: -it.distance_m):
        thing = one.thing
        draw_patch(canvas, thing.patch, one.from_view, one.box, thing.source, thing.fade)


def _once(things: Iterable[StandingPatch]) -> Sequence[StandingPatch]:
    """Return one patch for each object: that of the picture of the largest weight."""
    kept: list[StandingPatch] = []
    for each in sorted(things, key=lambda it: -it.weight):
        others = (k for k in kept if k.source != each.source)
        if all(math.dist(k.foot_m, each.foot_m) > SAME_M for k in others):
            kept.append(each)
    return kept


def _place_in(camera: Camera, thing: StandingPatch, from_view: Pose) -> _PatchInView | None:
    """Return the position of a patch in the view of ``camera``, None if it is not visible."""
    k, in_patch = camera.intrinsics, _corners(thing.patch)
    rotation = np.array(from_view.rotation_matrix())
    corners = (in_patch - from_view.translation_m) @ rotation
    z_m, middle = corners[:, 2], corners.mean(axis=0)
    if not (z_m.min() > NEAREST_M and z_m.max() < MOST_DISTANCE_M):
        return None
    ray, own_ray = rotation @ middle, in_patch.mean(axis=0)
    distance_m = float(np.linalg.norm(middle))
    if ray @ own_ray < LEAST_COSINE * distance_m * np.linalg.norm(own_ray):
        return None
    columns = _within(k.fx_px * corners[:, 0] / z_m + k.cx_px, k.width_px)
    rows = _within(k.fy_px * corners[:, 1] / z_m + k.cy_px, k.height_px)
    if columns.start == columns.stop or rows.start == rows.stop:
        return None
    return _PatchInView(thing, from_view, (rows, columns), distance_m)


def _corners(patch: Patch) -> F64:
    """Return the corners of a patch in the axes of its camera, metres [4, 3]."""
    k, (height, width) = patch.camera.intrinsics, patch.samples.shape[:2]
    u = np.array([0, width, 0, width]) + patch.left
    v = np.array([0, 0, height, height]) + patch.top
    x_m, y_m = (u - k.cx_px) / k.fx_px * patch.z_m, (v - k.cy_px) / k.fy_px * patch.z_m
    return np.stack((x_m, y_m, np.full(4, patch.z_m)), axis=1)


def _within(at_px: F64, size_px: int) -> slice:
    low, high = math.floor(at_px.min()), math.ceil(at_px.max())
    return slice(min(max(low, 0), size_px), min(max(high, 0), size_px))
