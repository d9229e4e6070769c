"""Undistortion: the picture a pinhole camera would have taken from the same place.

The pinhole keeps the size and the principal point; its focal lengths are scaled by one factor, the
smallest at which every pixel has a source (the widest view without blank edges). Pixels are
bilinear, as in COLMAP's and OpenCV's undistortion, in float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Intrinsics
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.lens import Lens

MIN_ZOOM = 0.5
"""A wide fisheye would be stretched without end; the middle keeps half its resolution."""
MAX_ZOOM = 8.0
BISECTIONS = 40
CACHED_MAPS = 2

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class SourceMap:
    """The four source pixels around each output pixel's origin, and their weights."""

    corner: NDArray[np.intp]
    right: F32
    down: F32


@lru_cache(maxsize=64)
def pinhole_of(intrinsics: Intrinsics, lens: Lens) -> Intrinsics:
    """Return the widest pinhole of the same size and principal point without blank pixels.

    Raises ``InvalidInput`` when there is none up to eight times the focal length.
    """
    edge = _edge_centres(intrinsics)
    low, high = MIN_ZOOM, MAX_ZOOM
    if not _all_inside(edge / high, intrinsics, lens):
        raise InvalidInput("lens", f"{lens} leaves blank pixels at {MAX_ZOOM:g} times the focal")
    if _all_inside(edge / low, intrinsics, lens):
        return _zoomed(intrinsics, low)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if _all_inside(edge / middle, intrinsics, lens):
            high = middle
        else:
            low = middle
    return _zoomed(intrinsics, high)


def undistorted(rgb: Rgb, intrinsics: Intrinsics, lens: Lens) -> Rgb:
    """Return the picture [H, W, 3] as ``pinhole_of(intrinsics, lens)`` sees it."""
    source = _source_map(intrinsics, lens)
    flat = rgb.reshape(-1, 3)
    width_px = intrinsics.width_px
    top = _mixed(flat, source.corner, source.right)
    bottom = _mixed(flat, source.corner + width_px, source.right)
    mixed = top + (bottom - top) * source.down[:, None]
    return (mixed + np.float32(0.5)).astype(np.uint8).reshape(rgb.shape)


def _mixed(flat: Rgb, first: NDArray[np.intp], share: F32) -> F32:
    a = flat[first].astype(np.float32)
    return np.asarray(a + (flat[first + 1].astype(np.float32) - a) * share[:, None])


@lru_cache(maxsize=CACHED_MAPS)
def _source_map(intrinsics: Intrinsics, lens: Lens) -> SourceMap:
    """Return where each pixel centre of the pinhole comes from; cached, as all frames share it."""
    k = intrinsics
    pinhole = pinhole_of(intrinsics, lens)
    u, v = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
    directions = np.stack(
        [(u.ravel() - k.cx_px) / pinhole.fx_px, (v.ravel() - k.cy_px) / pinhole.fy_px], axis=1
    )
    index = _pixels(lens.distort(directions), k) - 0.5
    last = np.array([k.width_px - 2, k.height_px - 2])
    corner = np.clip(np.floor(index), 0, np.maximum(last, 0)).astype(np.intp)
    share = np.clip(index - corner, 0.0, 1.0).astype(np.float32)
    return SourceMap(corner[:, 1] * k.width_px + corner[:, 0], share[:, 0], share[:, 1])


def _edge_centres(k: Intrinsics) -> F64:
    """Normalised coordinates of the outermost pixel centres at zoom 1."""
    u, v = np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5
    rows = [np.stack([u, np.full_like(u, at)], axis=1) for at in (v[0], v[-1])]
    columns = [np.stack([np.full_like(v, at), v], axis=1) for at in (u[0], u[-1])]
    edge = np.concatenate([*rows, *columns])
    return (edge - (k.cx_px, k.cy_px)) / (k.fx_px, k.fy_px)


def _all_inside(xy: F64, k: Intrinsics, lens: Lens) -> bool:
    """Return whether the lens images all directions onto pixel centres or between them."""
    if np.hypot(xy[:, 0], xy[:, 1]).max() > lens.max_radius:
        return False
    u, v = _pixels(lens.distort(xy), k).T
    across = (u >= 0.5) & (u <= k.width_px - 0.5)
    return bool((across & (v >= 0.5) & (v <= k.height_px - 0.5)).all())


def _pixels(xy: F64, k: Intrinsics) -> F64:
    return np.asarray(xy * (k.fx_px, k.fy_px) + (k.cx_px, k.cy_px))


def _zoomed(k: Intrinsics, zoom: float) -> Intrinsics:
    return replace(k, fx_px=k.fx_px * zoom, fy_px=k.fy_px * zoom)
