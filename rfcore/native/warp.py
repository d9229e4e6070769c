"""Carries the previous decoded picture to the present pose by depth; costs of 8x8 blocks.

Both ends compute the warp from what both hold, so every sample is defined here, in float32 without
fused operations and in integers; ``csrc/picture/warp.cpp`` computes exactly this on every machine.

Where: pixel (x, y) of the present camera, depth z = ``depth[y, x]``, has the ray
((x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1). With R, t mapping points of the present camera into
the previous camera's axes (float64, rounded once), row terms first::

    P = z * (R[:, 0] * ray_x + (R[:, 1] * ray_y + R[:, 2])) + t
    (u, v) = (fx * (Px / Pz) + cx - 0.5, fy * (Py / Pz) + cy - 0.5)

The sample is *known* when z > 0, Pz > 0.1, (u, v) lies inside the previous picture's outer
sample centres, and the previous depth at the nearest sample d satisfies
|d - Pz| < 0.08 Pz + 0.1: otherwise another surface was in front. Unknown samples are the render's.

What: (u, v) is rounded half up to 1/64 sample, and the previous picture is interpolated with
Lanczos-3, six taps a side at 6 bits, products summed without rounding, then
``(sum + 2**11) >> 12`` clamped to 1..255 (0 could not be spliced). The edge is repeated.

Chroma sits in the middle of its 2x2 luma samples (``rfcore.native.yuv``): it is known when all
four are, and its position is ((u1 + u2 + u3 + u4) / 4 - 0.5) / 2, rounded half up to 1/64. A last
odd column counts twice, and its u without the - 0.5, for it is where its chroma is; so v of a row.

The *correction* carries, instead of the picture, its signed difference from the field's render at
its own pose, and adds most of it to the present render: with ``sum`` as above,
``render + ((sum - clamp(sum >> 2, -4 * 2**12, 4 * 2**12) + 2**11) >> 12)``, clamped as above. A
quarter of a small difference is left out, for those are mostly noise, and 4 levels of a large one,
for those are mostly true. What the field shows wrongly from one pose it shows wrongly from the
next, while detail that resampling would soften comes from the render.

A *relit* render (``csrc/picture/light_grid.cpp``) is a render under the light in which an earlier
frame was seen: what that frame differs by from its own render is learnt by place and luma, a
bilateral grid (Chen, Paris and Durand 2007) of affine maps, and applied to the present render. No
depth or pose enters. Cells are 16x16 luma px, bins 32 levels; x is the render's luma - 128, d what
the frame's plane differs by from the render's, both at chroma resolution (luma: means of 2x2,
rounded half up). Every sample adds w (1, x, x^2, d, x d) to its cell's two nearest bins, their
weights adding up to 16. Numbers of a vertex are an offset in levels / 2**8 and a gain per level of
x in 1 / 2**15, solved by ridge regression (weights 160 and 16000) towards those of the next
coarser level: all of the picture, its bins, then cells of 16x16, 4x4 and 1 with sums filtered
by (1, 2, 1) over rows, columns and bins. A coarser level's numbers are repeated and filtered by
(1, 2, 1) / 4 over rows and columns. With n, sx, sxx, r, xr the sums of w, w x, w x^2 and of what
the prior leaves of d and x d::

    mean = round(2**11 sx / (n + 160))
    gain += round(2**7 (xr - (r mean >> 11)) / (max(sxx - (sx mean >> 11), 0) + 16000))
    offset += round((r - (sx gain_step >> 7)) / (n + 160))

both clamped to -2**16..2**16. What a sample's luma makes of each of the four cells around it, in
1/32 level and interpolated between bins, is interpolated between them in 1/32 of their distance,
rounded half up, added, and clamped to 1..255. Chroma is mapped by the rounded 2x2 mean of luma.

A light can be sent (``rfcore.codec.photometric``) where no earlier frame is there to learn it from:
the vertices of the level with 4x4 cells, solved as above from the frame itself, of each by how much
samples change in the middle of its bin, in levels / 2**8: their offsets, and no gain.

Lanczos-3 was chosen over a bicubic filter because a picture is resampled again and again along a
drive, and every pass of a softer filter takes away detail that has to be sent again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.backend import camera_numbers
from rfcore.views import FieldView

BLOCK_PX = 8
CORRECTION_DOUBT = 4
"""Levels. Squared errors of the luma prediction at 10 Hz empty, 10 Hz and 30 Hz with vehicles, and
at dusk with a field of noon: 69, 379, 193, 220; with 3/4 of every difference 68, 369, 229, 361, and
with all of it 72, 394, 199, 207. The warp has 92, 411, 206, 226."""

MOST_RELIT_PX = 1 << 24
"""Largest picture whose sums fit 64 bits."""

LIGHT_CELL_PX, LIGHT_BINS, LIGHT_PLANES, MOST_CHANGE = 64, 8, 3, 1 << 16


@dataclass(frozen=True)
class BlockCosts:
    """Costs of predicting each whole 8x8 luma block: int32 [H // 8, W // 8].

    ``satd``: sum of absolute Hadamard coefficients / 8; ``ssd``: sum of squared differences.
    """

    satd: NDArray[np.int32]
    ssd: NDArray[np.int32]


def warp_i420(previous: I420, before: FieldView, now: FieldView, threads: int = 1) -> I420:
    """Return ``previous``, taken at ``before``, as it would look from ``now.camera``.

    Unknown samples are taken from ``now.render``. A device that holds both depths makes the same
    picture. Raises ``InvalidInput`` for pictures of another size, cameras of
    different intrinsics, or no threads.
    """
    return _carried(previous, None, before, now, threads)


def correct_i420(previous: I420, before: FieldView, now: FieldView, threads: int = 1) -> I420:
    """Return ``now.render`` plus most of the difference of ``previous`` from ``before.render``.

    The difference is carried from ``before.camera`` to ``now.camera``, as by ``warp_i420``. Raises
    ``InvalidInput`` for pictures of another size, cameras of different intrinsics, or no threads.
    """
    return _carried(previous, before.render, before, now, threads)


def _carried(
    previous: I420, minus: I420 | None, before: FieldView, now: FieldView, threads: int
) -> I420:
    if threads < 1:
        raise InvalidInput("threads", f"{threads} must be at least 1")
    if before.camera.intrinsics != now.camera.intrinsics:
        raise InvalidInput("warp", "the two cameras have different intrinsics")
    size_px = now.render.size_px
    if previous.size_px != size_px:
        raise InvalidInput("warp.previous", f"{previous.size_px} px of a camera of {size_px} px")
    if now.held_depth is not None and before.held_depth is not None:
        made = now.held_depth.carry(previous, minus, before, now)
        if made is not None:
            return made
    out = I420.empty(now.render.size_px)
    _native.warp_i420(
        previous.dense_planes(),
        np.ascontiguousarray(before.depth),
        np.ascontiguousarray(now.depth),
        now.render.dense_planes(),
        None if minus is None else minus.dense_planes(),
        0 if minus is None else CORRECTION_DOUBT,
        warp_numbers(before.camera, now.camera),
        *out.planes,
        threads,
    )
    return out


def relight_i420(seen: I420, seen_render: I420, render: I420) -> I420:
    """Return ``render`` under the light of ``seen``, whose render is ``seen_render``.

    Raises ``InvalidInput`` for pictures of another size, without samples, or above 2**24 px.
    """
    size_px = _check_relit(render)
    for name, picture in (("seen", seen), ("seen_render", seen_render)):
        if picture.size_px != size_px:
            raise InvalidInput(f"relight.{name}", f"{picture.size_px} px of a render of {size_px}")
    out = I420.empty(render.size_px)
    _native.relight_i420(
        seen.dense_planes(), seen_render.dense_planes(), render.dense_planes(), *out.planes
    )
    return out


def light_shape(size_px: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the shape of a light to be sent: rows, columns, bins and planes."""
    width_px, height_px = size_px
    return -(-height_px // LIGHT_CELL_PX), -(-width_px // LIGHT_CELL_PX), LIGHT_BINS, LIGHT_PLANES


def solve_light(frame: I420, render: I420) -> NDArray[np.int32]:
    """Return the light that maps ``render`` to ``frame``: changes in levels / 2**8, int32
    (``light_shape``), within 2**16.

    Raises ``InvalidInput`` for pictures of different sizes, without samples, or above 2**24 px.
    """
    size_px = _check_relit(render)
    if frame.size_px != size_px:
        raise InvalidInput("light.frame", f"{frame.size_px} px of a render of {size_px}")
    changes = np.empty(light_shape(size_px), np.int32)
    _native.solve_light(frame.dense_planes(), render.dense_planes(), changes)
    return changes


def apply_light(render: I420, changes: NDArray[np.int32]) -> I420:
    """Return ``render`` under the light ``changes``, as ``solve_light`` returns it.

    Raises ``InvalidInput`` for changes of another shape or beyond 2**16, and for pictures without
    samples or above 2**24 px.
    """
    shape = light_shape(_check_relit(render))
    if changes.shape != shape or np.abs(changes).max() > MOST_CHANGE:
        raise InvalidInput("light", f"must be of shape {shape} and within 2**16")
    out = I420.empty(render.size_px)
    dense = np.ascontiguousarray(changes, np.int32)
    _native.apply_light(dense, render.dense_planes(), *out.planes)
    return out


def _check_relit(render: I420) -> tuple[int, int]:
    width_px, height_px = render.size_px
    if not 0 < width_px * height_px <= MOST_RELIT_PX:
        raise InvalidInput(
            "relight.render", f"{render.size_px} px must be 1 to {MOST_RELIT_PX} px in all"
        )
    return width_px, height_px


def warp_numbers(before: Camera, now: Camera) -> list[float]:
    """Return R (9, row-major), t (3), fx, fy, cx, cy of the warp from ``now`` into ``before``."""
    motion = before.cam_from_world().compose(now.world_from_cam)
    return camera_numbers(motion.rotation_matrix(), motion.translation_m, now.intrinsics)


def block_costs(frame: NDArray[np.uint8], reference: NDArray[np.uint8]) -> BlockCosts:
    """Return the residual of predicting the luma plane ``frame`` from ``reference``, by blocks."""
    if frame.shape != reference.shape:
        raise InvalidInput("reference", f"shape {reference.shape} of a frame {frame.shape}")
    shape = (frame.shape[0] // BLOCK_PX, frame.shape[1] // BLOCK_PX)
    costs = BlockCosts(np.zeros(shape, np.int32), np.zeros(shape, np.int32))
    _native.block_costs(
        np.ascontiguousarray(frame), np.ascontiguousarray(reference), costs.satd, costs.ssd
    )
    return costs
