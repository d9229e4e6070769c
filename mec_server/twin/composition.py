"""The street as it is now, from any viewpoint: a field's render and what live pictures change.

Without clock, sockets or threads. What is carried is not a picture but its difference from the
field's own render at the picture's pose, brought into the light of the field and limited to regions
that differ by more than noise: where nothing changed, a view is the render to the bit, and detail
that resampling would soften comes from the render.

A pixel of the view at depth z lies at P in the axes of a live camera, as in ``rfcore.native.warp``.
The camera *vouches* for it when P projects into its picture, lies in front of it and within
``MOST_DISTANCE_M``, is the surface that its own field depth shows there
(``|d - Pz| < 0.08 Pz + 0.1``), is seen within 60 degrees of the view's direction, and at no less
than a quarter of the view's resolution. Its weight is the product of

* age: 1 at capture, 0 at the age from which pictures vouch for nothing,
* angle: the fourth power of the cosine between the two directions,
* resolution: pixels per metre of the live picture over those of the view, at most 1,
* distance: 1 - Pz / ``MOST_DISTANCE_M``, and
* trust: 1 less the share of the picture that disagrees with the field.

Of several cameras the weighted median of the differences (by their mean over RGB) is taken, so that
one that is alone with its opinion is outvoted by two. A camera of which more than half disagrees
with the field, as with a wrong pose, vouches for nothing. In the last half of its time a difference
fades, so that a vehicle that is gone leaves nothing standing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics
from rfcore.image import I420, Rgb
from rfcore.native.yuv import rgb_from_i420
from rfcore.raster.gaussians import F32
from rfcore.views import View

__all__ = ["MOST_DISTANCE_M", "ComposedView", "LivePicture", "compose", "live_picture", "shrunk"]

MOST_DISTANCE_M = 40.0
"""How far from a camera its picture vouches."""

LEAST_COSINE = 0.5
LEAST_RESOLUTION = 0.25
NEAREST_M = 0.1
RELATIVE_DEPTH, ABSOLUTE_DEPTH_M = np.float32(0.08), np.float32(0.1)
"""As in the codec's warp: what differs more is another surface."""

COVERED = 0.5
"""Opacity from which the field has a surface."""
MEAN_PX = 7
"""Side of the window whose mean difference tells a change from noise and from blurred edges."""
NOISE_LEVELS, CHANGE_LEVELS = 10.0, 20.0
"""Mean differences below the first are noise, from the second on a change; between, a part of it is
carried."""
MOST_DISAGREEMENT = 0.5
"""Share of a picture; one that differs in more is taken to be somewhere else."""

MOST_GAIN = 4.0
SAME_GAIN, SAME_OFFSET = 0.05, 4.0
"""A fitted light within these is the field's own."""
FIT_STEP_PX = 4
FIT_ROUNDS = 4

MOST_LIVE_PX = 960 * 540
"""Live pictures larger than this are shrunk by a whole factor first."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LivePicture:
    """What one camera's picture changes in the field.

    ``difference``: float32 [H, W, 3], levels in the light of the field, 0 where there is only
    noise. ``depth``: the field's, float32 [H, W]. ``trust``: 0 (outvoted) to 1. ``changed``: bool
    [H, W], where it is more likely a change than noise.
    """

    camera: Camera
    difference: F32
    depth: F32
    trust: float
    changed: Mask


@dataclass(frozen=True, eq=False)
class ComposedView:
    """``rgb`` uint8 [H, W, 3]; ``depth`` of the field, float32 [H, W], metres, 0: nothing hit.

    ``age_s``: float32 [H, W], of the picture that vouches for a pixel, infinite where none does.
    ``shares``: of the pixels, for each live picture.
    """

    rgb: Rgb
    depth: F32
    age_s: F32
    shares: tuple[float, ...]


def shrunk(picture: I420, intrinsics: Intrinsics) -> tuple[Rgb, Intrinsics]:
    """Return a picture as RGB, and its camera; a large one as means of whole squares of pixels."""
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
    """Return what ``rgb``, uint8 [H, W, 3], changes in the field that shows ``view`` there."""
    render = _levels(view)
    covered = view.opacity > COVERED
    difference = _in_light_of(render, rgb.astype(np.float32), covered) - render
    change = np.abs(_box_mean(difference)).max(axis=2)
    part = np.clip((change - NOISE_LEVELS) / (CHANGE_LEVELS - NOISE_LEVELS), 0.0, 1.0)
    part[~covered] = 0.0
    seen = int(covered.sum())
    disagreement = float((part > 0.5).sum() / seen) if seen else 1.0
    trust = 0.0 if disagreement > MOST_DISAGREEMENT else 1.0 - disagreement
    depth = np.where(covered, view.depth, np.float32(0))
    carried = difference * part[:, :, None].astype(np.float32)
    return LivePicture(camera, carried, depth, trust, part > 0.5)


def compose(
    camera: Camera,
    view: View,
    pictures: Sequence[tuple[LivePicture, float]],
    max_age_s: float,
) -> ComposedView:
    """Return ``view``, the field's render at ``camera``, with live pictures of the given age (s)
    carried to it. Pictures as old as ``max_age_s`` vouch for nothing."""
    render = _levels(view)
    shape = (len(pictures), *view.depth.shape)
    differences = np.zeros((*shape, 3), np.float32)
    weights = np.zeros(shape, np.float32)
    depth = np.where(view.opacity > COVERED, view.depth, np.float32(0))
    ages = np.array([max(0.0, age_s) for _, age_s in pictures], np.float32)
    for index, (picture, _) in enumerate(pictures):
        youth = 1.0 - float(ages[index]) / max_age_s
        if youth > 0 and picture.trust > 0:
            _carry(picture, camera, depth, differences[index], weights[index])
            weights[index] *= np.float32(youth * picture.trust)
            differences[index] *= np.float32(min(1.0, 2.0 * youth))
    if not pictures:
        nowhere = np.full(depth.shape, np.inf, np.float32)
        return ComposedView(_rounded(render), view.depth, nowhere, ())
    chosen, vouched = _weighted_medians(differences.mean(axis=3), weights)
    taken = np.take_along_axis(differences, chosen[None, :, :, None], axis=0)[0]
    age_s = np.where(vouched, ages[chosen], np.float32(np.inf))
    shares = tuple(float((vouched & (chosen == i)).mean()) for i in range(len(pictures)))
    rgb = _rounded(render + np.where(vouched[:, :, None], taken, np.float32(0)))
    return ComposedView(rgb, view.depth, age_s, shares)


def _levels(view: View) -> F32:
    """Return a render's colour as whole levels 0..255, float32, as a picture would hold it."""
    return _rounded(view.colour * np.float32(255)).astype(np.float32)


def _rounded(levels: F32) -> Rgb:
    return np.asarray(np.rint(levels.clip(0, 255)), np.uint8)


def _in_light_of(render: F32, picture: F32, covered: Mask) -> F32:
    """Return ``picture`` as it would look under the light of ``render``: a gain and an offset for
    each channel, fitted by least squares to the pixels that fit best."""
    step = slice(None, None, FIT_STEP_PX)
    inside = covered[step, step]
    out = picture.copy()
    for channel in range(3):
        x, y = render[step, step, channel][inside], picture[step, step, channel][inside]
        gain, offset = _line_through(x.astype(np.float64), y.astype(np.float64))
        if abs(gain - 1.0) > SAME_GAIN or abs(offset) > SAME_OFFSET:
            out[:, :, channel] = (picture[:, :, channel] - offset) / gain
    return out


def _line_through(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return gain and offset of y over x, least squares over the half that fits best.

    Where x hardly varies there is no gain to be seen, and none is taken.
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


def _box_mean(values: F32) -> F32:
    """Return the mean over MEAN_PX x MEAN_PX pixels [H, W, 3], the edge repeated."""
    half = MEAN_PX // 2
    padded = np.pad(values, ((half + 1, half), (half + 1, half), (0, 0)), mode="edge")
    sums = padded.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    n = MEAN_PX
    window = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    return np.asarray(window / n**2, np.float32)


def _carry(picture: LivePicture, camera: Camera, depth: F32, difference: F32, weight: F32) -> None:
    """Write the difference and its weight, without age and trust, where ``picture`` vouches."""
    k, live = camera.intrinsics, picture.camera.intrinsics
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns]
    ray = np.empty((len(z), 3), np.float32)
    ray[:, 0] = (columns + np.float32(0.5 - k.cx_px)) / np.float32(k.fx_px)
    ray[:, 1] = (rows + np.float32(0.5 - k.cy_px)) / np.float32(k.fy_px)
    ray[:, 2] = 1.0
    motion = picture.camera.cam_from_world().compose(camera.world_from_cam)
    turn = np.array(motion.rotation_matrix(), np.float32)
    towards = ray @ turn.T
    points = towards * z[:, None] + np.array(motion.translation_m, np.float32)
    pz = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = points[:, 0] / pz * np.float32(live.fx_px) + np.float32(live.cx_px - 0.5)
        v = points[:, 1] / pz * np.float32(live.fy_px) + np.float32(live.cy_px - 0.5)
        inside = (pz > NEAREST_M) & (pz < MOST_DISTANCE_M)
        inside &= (u >= 0) & (u <= live.width_px - 1) & (v >= 0) & (v <= live.height_px - 1)
    at = np.flatnonzero(inside)
    u, v, pz, points, towards = u[at], v[at], pz[at], points[at], towards[at]
    seen = picture.depth[np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)]
    cosine = (points * towards).sum(axis=1) / (
        np.linalg.norm(points, axis=1) * np.linalg.norm(towards, axis=1)
    )
    resolution = np.float32(live.fx_px / k.fx_px) * z[at] / pz
    same = np.abs(seen - pz) < RELATIVE_DEPTH * pz + ABSOLUTE_DEPTH_M
    same &= (seen > 0) & (cosine > LEAST_COSINE) & (resolution > LEAST_RESOLUTION)
    to = (rows[at][same], columns[at][same])
    near = 1 - pz[same] / np.float32(MOST_DISTANCE_M)
    weight[to] = cosine[same] ** 4 * np.minimum(resolution[same], 1) * near
    difference[to] = _sampled(picture.difference, u[same], v[same])


def _sampled(values: F32, u: F32, v: F32) -> F32:
    """Return ``values`` [H, W, 3] at sample positions inside of it, bilinearly: [N, 3]."""
    height, width = values.shape[:2]
    left = np.minimum(u.astype(np.intp), max(width - 2, 0))
    top = np.minimum(v.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (u - left)[:, None], (v - top)[:, None]
    upper = values[top, left] * (1 - across) + values[top, right] * across
    lower = values[bottom, left] * (1 - across) + values[bottom, right] * across
    return np.asarray(upper * (1 - down) + lower * down, np.float32)


def _weighted_medians(values: F32, weights: F32) -> tuple[NDArray[np.intp], Mask]:
    """Return which of N values [N, H, W] is the weighted median of each pixel [H, W], and where
    there is any weight."""
    shape = values.shape[1:]
    total = weights.sum(axis=0)
    if len(values) < 2:
        return np.zeros(shape, np.intp), total > 0
    order = np.argsort(values, axis=0, kind="stable")
    reached = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    place = (reached >= total / 2).argmax(axis=0)
    chosen = np.take_along_axis(order, place[None], axis=0)[0]
    return chosen, total > 0
