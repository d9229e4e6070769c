"""Live views: finds what a live picture changes in a field, carries the changes of several pictures
to another view, and draws cut-outs of pictures there as upright planes.

``csrc/picture/live_view.cpp`` and ``patch.cpp`` compute exactly what is defined here, in float32
without fused operations: the same bytes on every machine.

*Change* (``live_difference``). A picture is ``gain * colour + offset`` in the light of the day; its
difference from the field's render, in the light of the field, is
``(picture - offset) / gain - level(colour)`` for red, green and blue, where ``level`` is
``round(clip(255 c, 0, 255))``, halves to even. The mean difference over 7x7 pixels (the edge
repeated; rows summed from above, then columns from the left), of the channel where it is largest,
below ``NOISE_LEVELS`` is noise, from ``CHANGE_LEVELS`` on a change, both times ``brightness``;
between, that share of the difference is kept. Without a surface of the field (opacity of at most
``COVERED``) none is.

*Carrying* (``carry_to_view``). Pixel (x, y) of the view, of depth z, has the ray
((x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1). With R, t mapping points of the view's axes into
those of a live camera, row terms first::

    T = R[:, 0] * ray_x + (R[:, 1] * ray_y + R[:, 2]);   P = z * T + t
    (u, v) = (Px / Pz * fx' + (cx' - 0.5), Py / Pz * fy' + (cy' - 0.5))

The camera *vouches* for the pixel when the view's opacity is above ``COVERED``, Pz lies between
``NEAREST_M`` and ``MOST_DISTANCE_M``, (u, v) inside its outer sample centres, the field has a
surface there at depth d with ``|d - Pz| < 0.08 Pz + 0.1`` (else another one is in front), the angle
between P and T has a cosine c > ``LEAST_COSINE``, and it sees the surface with at least a quarter
of the view's resolution, ``r = fx' / fx * z / Pz``. Its weight is the source's times
``c**4 * min(r, 1) * (1 - Pz / MOST_DISTANCE_M)``.

Its change is taken at (u, v) bilinearly, times the source's ``fade``. Several of one ``owner`` that
vouch for a pixel share their weight there: each counts divided by how many they are. Of several
that vouch, the weighted median by the sum of the three channels counts: one that is alone with its
opinion is outvoted by two. The picture is ``level(colour)`` plus that, rounded and clamped
likewise.

*Patches* (``draw_patch``). With the ray of a pixel as above, and R, t mapping points of the view's
axes into those of the patch's camera::

    T = R[:, 0] * ray_x + (R[:, 1] * ray_y + R[:, 2]);   z = (z_m - t_z) / T_z;   P = z * T + t
    (u, v) = (Px / z_m * fx' + (cx' - 0.5) - left, Py / z_m * fy' + (cy' - 0.5) - top)

The patch is sampled there bilinearly, upper row first, colours weighted by its mask, so that what
is beside a thing does not bleed into it; outside of it there is nothing. A pixel is the thing's
where T_z > 1e-6, z lies between ``NEAREST_M`` and ``Canvas.nearest_m``, and the mask is above
``LEAST_MASK``. Its colour is that behind it plus ``fade`` times the difference, rounded, halves to
even, and clipped to 0..255; its depth is z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Pose
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.native import _native
from rfcore.native.backend import camera_numbers
from rfcore.views import View

COVERED = 0.5
"""Opacity above which the field has a surface."""
NOISE_LEVELS, CHANGE_LEVELS = 16.0, 32.0
"""On the sample street, views from 1 to 3 m beside an unchanged drive lose up to 0.08 dB to false
changes. With 10 and 20 levels they lose 0.17 dB, and real changes gain 0.3 dB less."""

MOST_DISTANCE_M = 40.0
"""Most distance from a camera at which its picture is used."""
NEAREST_M = 0.1
RELATIVE_DEPTH, ABSOLUTE_DEPTH_M = 0.08, 0.1
"""Depths that differ more belong to another surface, as in the codec's warp."""
LEAST_COSINE = 0.5
LEAST_RESOLUTION = 0.25

LEAST_MASK = 0.5
MOST_SOURCES = 16
NOBODY = 255

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """A picture is ``gain`` times the field's colour plus ``offset`` levels, for each of RGB."""

    gain: tuple[float, float, float]
    offset: tuple[float, float, float]


OWN_LIGHT = Light((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class LiveSource:
    """A live picture's ``difference`` (float32 [H, W, 3]) from the field, and the field's ``depth``
    (float32 [H, W], metres) at its ``camera``. ``weight`` and ``fade`` apply to the whole picture;
    ``owner`` is a number of the vehicle, 0 to 2**24 (exact in float32)."""

    camera: Camera
    difference: F32
    depth: F32
    weight: float
    fade: float
    owner: int


@dataclass(frozen=True, eq=False)
class Patch:
    """A cut-out of the picture of ``camera``, from pixel (``left``, ``top``) on, that stands
    ``z_m`` along the optical axis.

    ``samples``: float32 [h, w, 4], red, green and blue (levels) times the mask, and the mask: 1
    where it shows the thing, 0 beside it.
    """

    camera: Camera
    samples: F32
    left: int
    top: int
    z_m: float


@dataclass(frozen=True, eq=False)
class Canvas:
    """The view of ``camera`` to draw on: ``rgb`` uint8 [H, W, 3]; ``depth`` float32 [H, W] in
    metres; ``chosen`` uint8 [H, W], the source of each pixel; ``nearest_m`` float32 [H, W], the
    depth up to which something drawn is in front of the pixel."""

    camera: Camera
    rgb: Rgb
    depth: F32
    chosen: NDArray[np.uint8]
    nearest_m: F32


def live_difference(rgb: Rgb, view: View, light: Light, brightness: float = 1.0) -> tuple[F32, F32]:
    """Return how ``rgb``, uint8 [H, W, 3], differs from the field's ``view`` at the same camera.

    ``brightness``: that of the field's light; 1 is daylight. The first result is the change in
    levels, float32 [H, W, 3]; the second, float32 [H, W], is its share of the raw difference.
    Raises ``InvalidInput`` for a picture of another size than the view.
    """
    if rgb.shape != view.colour.shape or rgb.dtype != np.uint8:
        raise InvalidInput(
            "picture", f"{rgb.dtype} {rgb.shape} beside a view {view.colour.shape}; uint8 is wanted"
        )
    difference, share = np.empty(rgb.shape, np.float32), np.empty(rgb.shape[:2], np.float32)
    _native.live_difference(
        np.ascontiguousarray(rgb),
        np.ascontiguousarray(view.colour),
        np.ascontiguousarray(view.opacity),
        [*light.gain, *light.offset],
        [brightness * NOISE_LEVELS, brightness * CHANGE_LEVELS, COVERED],
        difference,
        share,
    )
    return difference, share


def carry_to_view(
    camera: Camera, view: View, sources: Sequence[LiveSource]
) -> tuple[Rgb, NDArray[np.uint8]]:
    """Return ``view``, the field's render at ``camera``, with the changes of ``sources``.

    The first result is the picture, uint8 [H, W, 3]; the second, uint8 [H, W], the source of each
    pixel, ``NOBODY`` where it is the field's. Raises ``InvalidInput`` for more than
    ``MOST_SOURCES``.
    """
    if len(sources) > MOST_SOURCES:
        raise InvalidInput("sources", f"{len(sources)} are more than {MOST_SOURCES}")
    rgb = np.empty(view.colour.shape, np.uint8)
    chosen = np.empty(rgb.shape[:2], np.uint8)
    _native.carry_to_view(
        np.ascontiguousarray(view.colour),
        np.ascontiguousarray(view.opacity),
        np.ascontiguousarray(view.depth),
        _pinhole(camera),
        [_numbers(source, camera) for source in sources],
        [
            NEAREST_M,
            MOST_DISTANCE_M,
            RELATIVE_DEPTH,
            ABSOLUTE_DEPTH_M,
            LEAST_COSINE**2,
            LEAST_RESOLUTION,
            COVERED,
        ],
        rgb,
        chosen,
    )
    return rgb, chosen


def draw_patch(
    canvas: Canvas,
    patch: Patch,
    patch_from_view: Pose,
    box: tuple[slice, slice],
    source: int,
    fade: float,
) -> None:
    """Draw a ``patch`` of picture ``source`` on ``canvas``, within the rows and columns ``box``.

    ``fade``, above 0 and at most 1, is the patch's share of the colour. ``patch_from_view`` maps
    points from the view's axes to those of the patch's camera.

    Raises ``InvalidInput`` for a box outside of the canvas, or a patch at no depth.
    """
    rows, columns = box
    height, width = canvas.depth.shape
    if not (0 <= rows.start <= rows.stop <= height and 0 <= columns.start <= columns.stop <= width):
        raise InvalidInput("patch.box", f"{box} is outside of {width}x{height} px")
    if not patch.z_m > 0:
        raise InvalidInput("patch.z_m", f"{patch.z_m} m must be above 0")
    if not 0 <= source < NOBODY:
        raise InvalidInput("patch.source", f"{source} is outside 0..{NOBODY - 1}")
    rotation, k = patch_from_view.rotation_matrix(), patch.camera.intrinsics
    numbers = camera_numbers(rotation, patch_from_view.translation_m, k)
    numbers += [float(patch.left), float(patch.top), patch.z_m, fade]
    _native.draw_patch(
        np.ascontiguousarray(patch.samples),
        numbers,
        source,
        [NEAREST_M, LEAST_MASK],
        [rows.start, rows.stop, columns.start, columns.stop],
        _pinhole(canvas.camera),
        canvas.rgb,
        canvas.depth,
        canvas.chosen,
        canvas.nearest_m,
    )


def _numbers(source: LiveSource, camera: Camera) -> tuple[F32, F32, list[float]]:
    motion = source.camera.cam_from_world().compose(camera.world_from_cam)
    k = source.camera.intrinsics
    numbers = camera_numbers(motion.rotation_matrix(), motion.translation_m, k)
    numbers += [source.weight, source.fade, float(source.owner)]
    depth, difference = map(np.ascontiguousarray, (source.depth, source.difference))
    return difference, depth, numbers


def _pinhole(camera: Camera) -> list[float]:
    k = camera.intrinsics
    return [k.fx_px, k.fy_px, k.cx_px, k.cy_px]
