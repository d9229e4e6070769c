"""Renders a picture at half its width and height and enlarges it, for a quarter of the pixels.

Pixel centres are at +0.5, so a half-size pixel k covers pixels 2k and 2k + 1, and pixel i lies at
(i + 0.5) / 2 in half-size coordinates: a quarter from one half-size centre and three quarters from
the next. Colour and opacity are interpolated so, in float32, first down the columns and then along
the rows, ``0.75 near + 0.25 far`` without fused operations: the same bytes on every machine. The
edge is repeated. Depth is not interpolated, since a mean of two surfaces is no surface; a pixel has
that of the half-size pixel it lies in. Of odd sides the half-size camera sees half a pixel more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics
from rfcore.field.quality import Quality
from rfcore.views import View

F32 = NDArray[np.float32]


def view_at_scale(
    render: Callable[[Camera, Quality], View], camera: Camera, quality: Quality
) -> View:
    """Render at ``quality.scale``, and return the view in the size of ``camera``."""
    if quality.scale == 1:
        return render(camera, quality)
    small = render(_half(camera), replace(quality, scale=1.0))
    height, width = camera.intrinsics.height_px, camera.intrinsics.width_px
    depth = small.depth.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return View(
        _doubled(small.colour, height, width),
        np.ascontiguousarray(depth),
        _doubled(small.opacity, height, width),
    )


def colour_at_scale(
    render: Callable[[Camera, Quality], F32], camera: Camera, quality: Quality
) -> F32:
    """Return the colour of ``view_at_scale`` where ``render`` makes only colour."""
    if quality.scale == 1:
        return render(camera, quality)
    small = render(_half(camera), replace(quality, scale=1.0))
    return _doubled(small, camera.intrinsics.height_px, camera.intrinsics.width_px)


def _half(camera: Camera) -> Camera:
    k = camera.intrinsics
    half = Intrinsics(
        (k.width_px + 1) // 2,
        (k.height_px + 1) // 2,
        k.fx_px / 2,
        k.fy_px / 2,
        k.cx_px / 2,
        k.cy_px / 2,
    )
    return Camera(half, camera.world_from_cam)


def _doubled(picture: F32, height: int, width: int) -> F32:
    tall = _doubled_rows(picture, height)
    wide = _doubled_rows(tall.swapaxes(0, 1), width).swapaxes(0, 1)
    return np.ascontiguousarray(wide)


def _doubled_rows(picture: F32, count: int) -> F32:
    """Return twice the rows of ``picture``, the first ``count`` of them."""
    near = picture * np.float32(0.75)
    far = picture * np.float32(0.25)
    out = np.empty((2 * len(picture), *picture.shape[1:]), np.float32)
    out[0::2] = near
    out[1::2] = near
    out[2::2] += far[:-1]
    out[0] += far[0]
    out[1:-1:2] += far[1:]
    out[-1] += far[-1]
    return out[:count]
