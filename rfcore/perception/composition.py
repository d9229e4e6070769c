"""Composition of the street as it is now, from any viewpoint: a field's render with the changes
that live pictures show.

Without clock, sockets or threads. A live picture is carried to a view as its difference from the
field's own render at the picture's pose, brought into the light of the field and limited to regions
that differ by more than noise: where nothing changed, a view is the render to the bit, and detail
that resampling would soften comes from the render. ``rfcore.native.live_view`` defines what a
change is, and which camera vouches for which pixel of a view.

Beside angle, resolution and distance, a camera's weight depends on

* age: 1 at capture, 0 at the age from which pictures vouch for nothing, and
* trust: 1 less the share of the picture that disagrees with the field; little where the picture
  would fit the field elsewhere than at its pose (``rfcore.perception.misplacement``).

Pictures of one vehicle share a weight where several of them vouch for a pixel: a rig counts no more
than one camera.

Objects that the field lacks come as patches at their own depth (``rfcore.perception.patches``),
once they were found (``rfcore.perception.contacts``).

A camera of which more than half disagrees with the field, as with a wrong pose, vouches for
nothing. In the last half of its time a difference fades, so that a vehicle that left leaves nothing
behind.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose, Vec3
from rfcore.image import I420, Rgb
from rfcore.native.live_view import (
    ABSOLUTE_DEPTH_M,
    COVERED,
    LEAST_COSINE,
    MOST_DISTANCE_M,
    NEAREST_M,
    OWN_LIGHT,
    RELATIVE_DEPTH,
    Canvas,
    Light,
    LiveSource,
    Patch,
    carry_to_view,
    live_difference,
)
from rfcore.native.yuv import rgb_from_i420
from rfcore.perception.misplacement import misplacement_rad
from rfcore.perception.patches import StandingPatch, draw_standing, in_front_of
from rfcore.raster.gaussians import F32
from rfcore.views import View

T = TypeVar("T")

MOST_CAMERAS, MOST_OF_ONE = 4, 2
"""Most live pictures carried to one view, and most of one vehicle while there are others."""
LOOKED_AT_M = (3.0, 6.0, 12.0, 24.0)
"""Distances of the points on a view's axis by which pictures are ranked."""

MOST_DISAGREEMENT = 0.5
"""Share of a picture that may differ from the field; one that differs in more has a wrong pose."""

LOOKED_FOR_M, SOMETHING = 25.0, 0.2
"""Objects further away may be too small to be found; less than this share of a box is no object."""

DAY_LEVELS, CONTRAST_POWER, LEAST_BRIGHTNESS = 85.0, 3, 0.5
"""Mean level of a field by day, and how contrast falls with it. At dusk the sample's mean is 0.78
of the day's; with limits half as high as by day 91 % of the vehicles are found there and no false
ones, with those of the day 77 %, with 0.78 of those 85 %."""

MISPLACED_RAD, MISPLACED_TRUST = 0.025, 0.25
"""A picture that would fit the field better by this angle has a wrong pose. On the sample's drives
the angle is 0.005 at most at the right poses, 0.013 with errors of 5 cm and 0.1 degree together,
0.024 with 10 cm and 0.2 degrees, and from 0.038 on with 0.5 m and 1 degree. With a trust of 0.3 an
honest picture behind it and older left up to 11 % of its content wrong, with 0.25 at most 4 %."""
SURE_TRUST = 0.93
"""Pictures of more trust are not aligned with the field: on the sample's empty drive those at the
right pose have 0.98, with errors of 0.5 m and 1 degree 0.89 at most."""
GREEN = 1

MOST_GAIN = 4.0
SAME_GAIN, SAME_OFFSET = 0.05, 4.0
"""A fitted light with less gain and offset than this is the field's own."""
FIT_STEP_PX = 4
FIT_ROUNDS = 4

MOST_LIVE_PX = 960 * 540
"""Live pictures larger than this are scaled down by a whole factor first."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of an object in a picture.

    ``box``: rows and columns, ``mask``: bool in them; ``z_m``: depth along the optical axis;
    ``foot_m``: where it stands, in the field's axes.
    """

    box: tuple[slice, slice]
    mask: Mask
    z_m: float
    foot_m: Vec3


@dataclass(frozen=True, eq=False)
class LivePicture:
    """The difference of one camera's picture from the field.

    ``difference``: float32 [H, W, 3], levels in the light of the field, 0 where there is only
    noise. ``depth``: the field's, float32 [H, W]. ``trust``: 0 (outvoted) to 1. ``changed``: bool
    [H, W], true where a change is more likely than noise. ``colour``: the field's, float32 [H, W,
    3]. ``brightness``: that of the field's light, 1 by day: objects differ less from the street
    where both are darker. ``things``: the objects cut out of all of these (``with_things``).
    """

    camera: Camera
    difference: F32
    depth: F32
    trust: float
    changed: Mask
    colour: F32
    brightness: float
    things: tuple[StandingPatch, ...] = ()

    def rules_out(self, at_m: Vec3, width_m: float, height_m: float) -> bool:
        """Return whether the picture should show an object with its foot at ``at_m`` and does not.

        It should if the foot is in the picture, within ``LOOKED_FOR_M``, and no surface of the
        field hides it; it does not if less than ``SOMETHING`` of the object's box differs from the
        field. A picture that is outvoted rules nothing out.
        """
        k = self.camera.intrinsics
        x_m, y_m, z_m = self.camera.cam_from_world().apply(at_m)
        if self.trust == 0 or not NEAREST_M < z_m <= LOOKED_FOR_M:
            return False
        foot_px = round(k.fy_px * y_m / z_m + k.cy_px - 0.5)
        middle_px = round(k.fx_px * x_m / z_m + k.cx_px - 0.5)
        half_px = max(1, round(k.fx_px * width_m / z_m / 2))
        top_px = max(0, foot_px - max(1, round(k.fy_px * height_m / z_m)))
        if not (half_px <= middle_px < k.width_px - half_px and 0 < foot_px < k.height_px - 1):
            return False
        surface_m = float(self.depth[foot_px, middle_px])
        if surface_m < z_m * (1 - RELATIVE_DEPTH) - ABSOLUTE_DEPTH_M:
            return False
        box = (slice(top_px, foot_px), slice(middle_px - half_px, middle_px + half_px + 1))
        return float(self.changed[box].mean()) < SOMETHING


@dataclass(frozen=True, eq=False)
class ComposedView:
    """A composed view.

    ``rgb`` uint8 [H, W, 3]; ``depth`` of the field or of an object before it, float32 [H, W],
    metres, 0 where nothing is hit. ``age_s``: float32 [H, W], age of the picture that vouches for a
    pixel, infinite where none does. ``shares``: the share of the pixels that each live picture
    vouches for.
    """

    rgb: Rgb
    depth: F32
    age_s: F32
    shares: tuple[float, ...]


def shrunk(picture: I420, intrinsics: Intrinsics) -> tuple[Rgb, Intrinsics]:
    """Return a picture as RGB and its camera; large ones are averaged over squares of pixels."""
    rgb = rgb_from_i420(picture)
    factor = 1
    while intrinsics.width_px * intrinsics.height_px > MOST_LIVE_PX * factor * factor:
        factor += 1
    if factor == 1:
        return rgb, intrinsics
    height, width = intrinsics.height_px // factor, intrinsics.width_px // factor
    squares = rgb[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    k = intrinsics
    small = Intrinsics(
        width, height, k.fx_px / factor, k.fy_px / factor, k.cx_px / factor, k.cy_px / factor
    )
    return np.rint(squares.mean(axis=(1, 3))).astype(np.uint8), small


def live_picture(camera: Camera, rgb: Rgb, view: View) -> LivePicture:
    """Return the difference of ``rgb``, uint8 [H, W, 3], from ``view``, the field's render
    there."""
    covered = view.opacity > COVERED
    light = _light_of(rgb, view, covered)
    brightness = _brightness_of(view, covered)
    difference, share = live_difference(rgb, view, light, brightness)
    changed = share > 0.5
    seen = int(covered.sum())
    disagreement = float(changed.sum() / seen) if seen else 1.0
    trust = 0.0 if disagreement > MOST_DISAGREEMENT else 1.0 - disagreement
    depth = np.where(covered, view.depth, np.float32(0))
    in_doubt = MISPLACED_TRUST < trust < SURE_TRUST
    if in_doubt and _is_misplaced(camera, rgb, view, light, depth):
        trust = MISPLACED_TRUST
    return LivePicture(camera, difference, depth, trust, changed, view.colour, brightness)


def _brightness_of(view: View, covered: Mask) -> float:
    """Return the share of the day's contrast that the field has on its surfaces, 1 at most."""
    step = slice(None, None, FIT_STEP_PX)
    seen = view.colour[step, step][covered[step, step]]
    if not len(seen):
        return 1.0
    of_day = 255 * float(seen.mean()) / DAY_LEVELS
    return min(1.0, max(LEAST_BRIGHTNESS, of_day**CONTRAST_POWER))


def _is_misplaced(camera: Camera, rgb: Rgb, view: View, light: Light, depth: F32) -> bool:
    """Return whether the green of a picture fits the field elsewhere than at its pose."""
    levels = rgb[..., GREEN].astype(np.float32)
    render = view.colour[..., GREEN] * np.float32(255 * light.gain[GREEN])
    render += np.float32(light.offset[GREEN])
    return misplacement_rad(levels, render, depth, camera.intrinsics) > MISPLACED_RAD


def with_things(picture: LivePicture, outlines: Sequence[Outline]) -> LivePicture:
    """Return ``picture`` with the objects in ``outlines`` as patches, without depth of the field
    there."""
    if not outlines:
        return picture
    depth = picture.depth.copy()
    for outline in outlines:
        depth[outline.box][outline.mask] = 0
    things = tuple(StandingPatch(_patch(picture, each), each.foot_m) for each in outlines)
    return replace(picture, depth=depth, things=things)


def _patch(picture: LivePicture, outline: Outline) -> Patch:
    rows, columns = outline.box
    level = np.rint((picture.colour[outline.box] * np.float32(255)).clip(0, 255))
    rgb = (level + picture.difference[outline.box]).clip(0, 255)
    mask = outline.mask[..., None].astype(np.float32)
    samples = np.concatenate((rgb * mask, mask), axis=2)
    return Patch(picture.camera, samples, columns.start, rows.start, outline.z_m)


def compose(
    camera: Camera,
    view: View,
    pictures: Sequence[tuple[LivePicture, float]],
    max_age_s: float,
    vehicles: Sequence[Hashable] = (),
) -> ComposedView:
    """Return ``view``, the field's render at ``camera``, with live pictures of the given age (s)
    carried to it. Pictures as old as ``max_age_s`` vouch for nothing.

    ``vehicles``: whose each picture is; without them every picture is of a vehicle of its own.
    """
    owners = vehicles or range(len(pictures))
    numbers = {owner: number for number, owner in enumerate(dict.fromkeys(owners))}
    ages_s = [max(0.0, age_s) for _, age_s in pictures]
    sources = []
    for (picture, _), age_s, owner in zip(pictures, ages_s, owners, strict=True):
        youth = max(0.0, 1.0 - age_s / max_age_s)
        fade = min(1.0, 2.0 * youth)
        weight = youth * picture.trust
        sources.append(
            LiveSource(
                picture.camera, picture.difference, picture.depth, weight, fade, numbers[owner]
            )
        )
    rgb, chosen = carry_to_view(camera, view, sources)
    depth, things = view.depth, list(_standing(pictures, sources))
    if things:
        depth = depth.copy()
        draw_standing(Canvas(camera, rgb, depth, chosen, in_front_of(view)), things)
    age_of_pixel_s, shares = np.full(chosen.shape, np.inf, np.float32), []
    for number, age_s in enumerate(ages_s):  # 1.5 ms at 640x360; by a table and bincount 2.0 ms
        own = chosen == number
        age_of_pixel_s[own] = age_s
        shares.append(np.count_nonzero(own) / chosen.size)
    return ComposedView(rgb, depth, age_of_pixel_s, tuple(shares))


def _standing(
    pictures: Sequence[tuple[LivePicture, float]], sources: Sequence[LiveSource]
) -> Iterator[StandingPatch]:
    """Yield the objects of the pictures that vouch for anything, with their weights."""
    for number, ((picture, _), source) in enumerate(zip(pictures, sources, strict=True)):
        if source.weight > 0:
            for each in picture.things:
                yield replace(each, source=number, weight=source.weight, fade=source.fade)


def nearest(
    pictures: Sequence[T],
    camera: Camera,
    pose_of: Callable[[T], Pose | None],
    vehicle_of: Callable[[T], Hashable] = id,
) -> list[T]:
    """Return the pictures of known pose that see most of the view of ``camera``, the best first.

    Of equal ones, and of those that see nothing of it, the nearest come first. There are at most
    ``MOST_OF_ONE`` of one vehicle while others are left.
    """
    ranked = []
    for order, picture in enumerate(pictures):
        pose = pose_of(picture)
        if pose is None:
            continue
        distance_m = math.dist(pose.translation_m, camera.world_from_cam.translation_m)
        if distance_m < 2 * MOST_DISTANCE_M:
            ranked.append((-_overlap(camera.world_from_cam, pose), distance_m, order))
    taken: list[T] = []
    spare: list[T] = []
    counts: Counter[Hashable] = Counter()
    for *_, order in sorted(ranked):
        vehicle = vehicle_of(pictures[order])
        counts[vehicle] += 1
        (taken if counts[vehicle] <= MOST_OF_ONE else spare).append(pictures[order])
    return [*taken, *spare][:MOST_CAMERAS]


def _overlap(view: Pose, live: Pose) -> float:
    """Return how well a camera at ``live`` vouches for the view of one at ``view``, 0 to 1.

    It is the mean over points on the view's axis, weighted as in ``rfcore.native.live_view``,
    without regard to occlusion.
    """
    cam_from_view, weights = live.inverse().compose(view), []
    origin_m = np.array(cam_from_view.translation_m)
    for ahead_m in LOOKED_AT_M:
        at_m = np.array(cam_from_view.apply((0.0, 0.0, ahead_m)))
        range_m = float(np.linalg.norm(at_m))
        ray_m = at_m - origin_m
        cosine = float(at_m @ ray_m) / max(range_m * ahead_m, 1e-9)
        seen = LEAST_COSINE * range_m < at_m[2] < MOST_DISTANCE_M and cosine > LEAST_COSINE
        weights.append(cosine**4 * (1 - at_m[2] / MOST_DISTANCE_M) if seen else 0.0)
    return float(np.mean(weights))


def _light_of(rgb: Rgb, view: View, covered: Mask) -> Light:
    """Return the light of ``rgb`` relative to the field's: a gain and an offset for each channel,
    fitted by least squares to the pixels that fit best."""
    step = slice(None, None, FIT_STEP_PX)
    inside = covered[step, step]
    render = np.rint((view.colour[step, step] * np.float32(255)).clip(0, 255))
    gains, offsets = list(OWN_LIGHT.gain), list(OWN_LIGHT.offset)
    for channel in range(3):
        x, y = render[..., channel][inside], rgb[step, step, channel][inside]
        gain, offset = _line_through(x.astype(np.float64), y.astype(np.float64))
        if abs(gain - 1.0) > SAME_GAIN or abs(offset) > SAME_OFFSET:
            gains[channel], offsets[channel] = gain, offset
    return Light((gains[0], gains[1], gains[2]), (offsets[0], offsets[1], offsets[2]))


def _line_through(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return gain and offset of y over x, least squares over the half that fits best.

    Where x hardly varies no gain can be found, and it is 1.
    """
    if len(x) < 16:
        return 1.0, 0.0
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(FIT_ROUNDS):
        error = np.abs(y - gain * x - offset)
        fits = error <= np.median(error)
        mean_x, mean_y = x[fits].mean(), y[fits].mean()
        spread = ((x[fits] - mean_x) ** 2).mean()
        if spread < 25.0:
            return 1.0, float(np.median(y - x))
        gain = float(((x[fits] - mean_x) * (y[fits] - mean_y)).mean() / spread)
        gain = min(max(gain, 1.0 / MOST_GAIN), MOST_GAIN)
        offset = float(mean_y - gain * mean_x)
    return gain, offset
