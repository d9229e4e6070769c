"""A field's picture through a lens, as simulators describe theirs.

A pinhole without distortion is rendered as it is. Else a pinhole as sharp as the middle of the
lens, wide enough for all of its picture, is rendered, and each pixel is taken from there: places
are rounded to 1/256 px and mixed bilinearly in whole numbers. What leads to the places is made of
operations that IEEE 754 defines to the last bit (its own tangent is among them), so that a picture
has the same bytes on every machine, as the render has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import MAX_SIDE_PX, Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.image import Rgb, rgb_from_colour
from rfcore.lens import BrownLens

F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]

MOST_PX = 1 << 24
"""Most pixels of a picture, and twice as many of the pinhole that is rendered for it."""
MOST_ANGLE_RAD = math.radians(75)
"""Directions farther from the axis are not rendered: a pinhole would be stretched without end."""
ANGLES = 1024
NEWTON_STEPS = 30
SHARE_BITS = 8
CACHED_MAPS = 16
TAN_TERMS = 24


@dataclass(frozen=True)
class RadialLens:
    """A lens whose radius is a function of the angle to its axis: fisheye and f-theta.

    ``radius_of_angle`` are coefficients of ascending powers; or, if ``angle_of_radius`` is not
    empty, those of its inverse. Radii are those of offsets from the principal point, divided by the
    focal lengths and ``linear`` (c, d, e): [c, d; e, 1] times an ideal offset is the offset.
    Pixels beyond ``max_angle_rad`` (0: no limit) are black.
    """

    radius_of_angle: tuple[float, ...]
    angle_of_radius: tuple[float, ...] = ()
    linear: tuple[float, float, float] = (1.0, 0.0, 0.0)
    max_angle_rad: float = 0.0

    def __post_init__(self) -> None:
        numbers = (*self.radius_of_angle, *self.angle_of_radius, *self.linear, self.max_angle_rad)
        if not all(map(math.isfinite, numbers)):
            raise InvalidInput("camera_intrinsics", f"{self} has a number that is not finite")
        reference = self.angle_of_radius or self.radius_of_angle
        if len(reference) < 2 or not reference[1] > 0:
            raise InvalidInput("camera_intrinsics", f"polynomial {reference} does not rise from 0")
        c, d, e = self.linear
        if not c - d * e > 0.01:
            raise InvalidInput("camera_intrinsics.linear_cde", f"{self.linear} has no inverse")

    def undistort(self, xy: F64) -> tuple[F64, F64]:
        """Return directions [N, 2] of sensor coordinates, and their angles [N] to the axis, which
        are infinite where no direction leads there."""
        c, d, e = self.linear
        x, y = xy[:, 0], xy[:, 1]
        determinant = c - d * e
        x, y = (x - d * y) / determinant, (c * y - e * x) / determinant
        radius = np.sqrt(x * x + y * y)
        angle = self._angle(radius)
        used = np.minimum(angle, MOST_ANGLE_RAD)
        ratio = np.where(radius > 1e-9, _tangent(used) / np.maximum(radius, 1e-9), 0.0)
        return np.stack([x * ratio, y * ratio], axis=1), angle

    def _angle(self, radius: F64) -> F64:
        if self.angle_of_radius:
            angle = _polynomial(self.angle_of_radius, radius)
            if not (angle >= -1e-6).all():
                raise InvalidInput(
                    "pixeldist_to_angle_poly", f"{self.angle_of_radius} falls below 0"
                )
            return np.asarray(np.maximum(angle, 0.0))
        limit = min(self.max_angle_rad or math.pi, math.pi)
        angles: F64 = np.arange(ANGLES + 1, dtype=np.float64) * (limit / ANGLES)
        radii = _polynomial(self.radius_of_angle, angles)
        rising = np.append(np.diff(radii) > 0, False)
        last = int(np.argmin(rising))
        if last == 0:
            raise InvalidInput("camera_intrinsics", f"{self.radius_of_angle} does not rise from 0")
        radii, angles = radii[: last + 1], angles[: last + 1]
        slopes = tuple(k * value for k, value in enumerate(self.radius_of_angle))[1:]
        index = np.clip(np.searchsorted(radii, radius), 1, last)
        low, high = angles[index - 1], angles[index]
        found = 0.5 * (low + high)
        for _ in range(NEWTON_STEPS):
            residual = _polynomial(self.radius_of_angle, found) - radius
            slope = np.maximum(_polynomial(slopes, found), 1e-9)
            found = np.clip(found - residual / slope, low, high)
        return np.where(radius <= radii[-1], found, np.inf)


@dataclass(frozen=True)
class LensModel:
    """``intrinsics`` act on the lens's sensor coordinates; None: no distortion."""

    intrinsics: Intrinsics
    lens: BrownLens | RadialLens | None = None

    def __post_init__(self) -> None:
        k = self.intrinsics
        if k.width_px * k.height_px > MOST_PX:
            size = f"{k.width_px}x{k.height_px} px"
            raise InvalidInput("resolution", f"{size} are above {MOST_PX} pixels")

    @property
    def pinhole(self) -> Intrinsics:
        """The pinhole that is rendered; ``InvalidInput`` for a lens that cannot be."""
        return self.intrinsics if self.lens is None else _places(self).pinhole

    def pinhole_pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the row and the column in the pinhole of each pixel, broadcastable to [H, W]."""
        k = self.intrinsics
        if self.lens is None:
            return np.arange(k.height_px)[:, None], np.arange(k.width_px)[None]
        places = _places(self)
        rows, columns = np.divmod(places.first, places.pinhole.width_px)
        return rows.reshape(k.height_px, -1), columns.reshape(k.height_px, -1)


@dataclass(frozen=True)
class _Places:
    """Where pixels of a lens's picture lie in a pinhole's, and their weights of 0..256."""

    pinhole: Intrinsics
    first: NDArray[np.intp]
    right: U32
    down: U32
    black: NDArray[np.bool_] | None


def render_through(field: RadianceField, model: LensModel, world_from_cam: Pose) -> Rgb:
    """Return the picture, uint8 [H, W, 3].

    Raises ``InvalidInput`` for a lens that cannot be rendered.
    """
    if model.lens is None:
        return rgb_from_colour(field.render_colour(Camera(model.intrinsics, world_from_cam)))
    places = _places(model)
    drawn = rgb_from_colour(field.render_colour(Camera(places.pinhole, world_from_cam)))
    return _mixed(drawn, places, (model.intrinsics.height_px, model.intrinsics.width_px))


def render_part(
    field: RadianceField, model: LensModel, world_from_cam: Pose, part: tuple[slice, slice]
) -> Rgb:
    """Return ``part`` (rows, columns) of the picture, rendering little else."""
    k = model.intrinsics
    (top, bottom, _), (left, right, _) = part[0].indices(k.height_px), part[1].indices(k.width_px)
    shape = (bottom - top, right - left)
    if model.lens is None:
        own = k.cropped(left, top, shape[1], shape[0])
        return rgb_from_colour(field.render_colour(Camera(own, world_from_cam)))
    places = _part_of(_places(model), (k.height_px, k.width_px), part)
    if places is None:
        return np.zeros((*shape, 3), np.uint8)
    drawn = rgb_from_colour(field.render_colour(Camera(places.pinhole, world_from_cam)))
    return _mixed(drawn, places, shape)


def _part_of(places: _Places, shape: tuple[int, int], part: tuple[slice, slice]) -> _Places | None:
    """Return the places of a part of the picture's ``shape``, in a crop of the pinhole; None if it
    is all black."""

    def own(values: Any) -> Any:
        return values.reshape(shape)[part].ravel()

    black = None if places.black is None else own(places.black)
    rows, columns = np.divmod(own(places.first), places.pinhole.width_px)
    shown = slice(None) if black is None else ~black
    if not rows[shown].size:
        return None
    top, left = int(rows[shown].min()), int(columns[shown].min())
    height, width = int(rows[shown].max()) - top + 2, int(columns[shown].max()) - left + 2
    first = (rows - top) * width + columns - left
    if black is not None:
        first[black] = 0
    pinhole = places.pinhole.cropped(left, top, width, height)
    return _Places(pinhole, first, own(places.right), own(places.down), black)


@lru_cache(maxsize=CACHED_MAPS)
def _places(model: LensModel) -> _Places:
    """Return the places of a lens's pixels; all of its pictures share them."""
    k, lens = model.intrinsics, model.lens
    assert lens is not None
    u, v = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
    sensor = np.stack([(u.ravel() - k.cx_px) / k.fx_px, (v.ravel() - k.cy_px) / k.fy_px], axis=1)
    black = None
    if isinstance(lens, BrownLens):
        xy = lens.undistort(sensor)
        farthest = math.atan(float(np.sqrt((xy * xy).sum(axis=1)).max()))
        sharp = (k.fx_px, k.fy_px)
    else:
        xy, angle = lens.undistort(sensor)
        if lens.max_angle_rad:
            black = ~(angle <= lens.max_angle_rad)
            xy[black], angle[black] = 0.0, 0.0
        farthest = float(angle.max())
        slope = 1 / lens.angle_of_radius[1] if lens.angle_of_radius else lens.radius_of_angle[1]
        sharp = (k.fx_px * slope, k.fy_px * slope)
    if not farthest <= MOST_ANGLE_RAD:
        sees = f"{math.degrees(farthest):.1f}" if math.isfinite(farthest) else "more than 180"
        raise InvalidInput(
            "camera_intrinsics",
            f"the lens sees {sees} degrees from its axis; at most "
            f"{math.degrees(MOST_ANGLE_RAD):g} are rendered: give max_angle or a smaller picture",
        )
    return _placed(xy, sharp, black)


def _placed(xy: F64, sharp: tuple[float, float], black: NDArray[np.bool_] | None) -> _Places:
    low, high = np.floor((xy * sharp).min(axis=0)) - 1, np.ceil((xy * sharp).max(axis=0)) + 1
    width, height = (high - low).astype(int).tolist()
    if max(width, height) > MAX_SIDE_PX or width * height > 2 * MOST_PX:
        raise InvalidInput(
            "camera_intrinsics",
            f"a pinhole for the lens has {width}x{height} px; at most {MAX_SIDE_PX} a side and "
            f"{2 * MOST_PX} in all are rendered: ask for a smaller picture",
        )
    pinhole = Intrinsics(width, height, *sharp, float(-low[0]), float(-low[1]))
    scale = 1 << SHARE_BITS
    index = np.floor((xy * sharp - low - 0.5) * scale + 0.5).astype(np.int64)
    index = np.clip(index, 0, (np.array([width, height]) - 1) * scale - 1)
    whole, share = index >> SHARE_BITS, (index & (scale - 1)).astype(np.uint32)
    first = (whole[:, 1] * width + whole[:, 0]).astype(np.intp)
    return _Places(pinhole, first, share[:, 0].copy(), share[:, 1].copy(), black)


def _mixed(drawn: Rgb, places: _Places, shape: tuple[int, int]) -> Rgb:
    """Return the pixels at the places, of a picture of ``shape`` (rows, columns); two colours at
    once, in halves of 32 bits."""
    height, width = drawn.shape[:2]
    packed = np.zeros((height, width, 4), np.uint8)
    packed[..., :3] = drawn
    flat: U32 = packed.reshape(-1, 4).view("<u4")[:, 0]
    corners = [flat[places.first + offset] for offset in (0, 1, width, width + 1)]
    halves = []
    for shift in (0, 8):
        a, b, c, d = ((corner >> np.uint32(shift)) & np.uint32(0xFF00FF) for corner in corners)
        top, bottom = _between(a, b, places.right), _between(c, d, places.right)
        halves.append(_between(top, bottom, places.down) << np.uint32(shift))
    mixed = np.ascontiguousarray(halves[0] | halves[1], "<u4")
    if places.black is not None:
        mixed[places.black] = 0
    pixels = mixed.view(np.uint8).reshape(*shape, 4)
    return np.ascontiguousarray(pixels[..., :3])


def _between(a: U32, b: U32, share: U32) -> U32:
    mixed = a * (np.uint32(256) - share) + b * share + np.uint32(0x800080)
    return np.asarray((mixed >> np.uint32(8)) & np.uint32(0xFF00FF))


def _polynomial(ascending: tuple[float, ...], at: F64) -> F64:
    total = np.zeros_like(at)
    for value in reversed(ascending):
        total = total * at + value
    return np.asarray(total)


def _tangent(angle: F64) -> F64:
    """Return the tangent of angles 0..75 degrees, by the series of sine and cosine."""
    square = angle * angle
    sine, cosine = np.ones_like(angle), np.ones_like(angle)
    for k in range(TAN_TERMS, 0, -2):
        sine = 1.0 - square / (k * (k + 1.0)) * sine
        cosine = 1.0 - square / (k * (k - 1.0)) * cosine
    return np.asarray(angle * sine / cosine)
