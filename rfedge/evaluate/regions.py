"""What each macroblock of a frame shows, by what the sender and the receiver could know of it.

Per pixel, in this order: *off-map*, where the field shows nothing; *moving*, where the camera
differs from the same drive through the empty street (parked objects count too: what is not in the
field); *entering*, where the field's surface was outside the previous view; *disoccluded*, where it
was inside but behind another surface; and *static*, all else. A macroblock is of the first kind
that covers a quarter of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.native.warp import PosedDepth
from rfedge.evaluate.foreground import by_macroblock

__all__ = ["KINDS", "macroblock_kinds"]

KINDS = ("static", "moving", "disoccluded", "entering", "off-map")
PRECEDENCE = ("off-map", "moving", "entering", "disoccluded")
SHARE = 0.25
NEAR_M = 0.1
RELATIVE_DEPTH, ABSOLUTE_DEPTH_M = 0.08, 0.1
"""How far two depths of one surface may differ; as in ``rfcore.native.warp``."""
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


def macroblock_kinds(
    before: PosedDepth, seen: PosedDepth, covered: Mask, foreground: Mask
) -> NDArray[np.int8]:
    """Return the index into ``KINDS`` of each macroblock, [ceil(H / 16), ceil(W / 16)]."""
    u, v, depth = _in_previous_view(before.camera, seen)
    height, width = seen.depth.shape
    inside = (depth > NEAR_M) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    columns = np.rint(np.clip(np.nan_to_num(u), 0, width - 1)).astype(int)
    rows = np.rint(np.clip(np.nan_to_num(v), 0, height - 1)).astype(int)
    there = before.depth[rows, columns]
    visible = np.abs(there - depth) < RELATIVE_DEPTH * depth + ABSOLUTE_DEPTH_M
    pixels = {
        "off-map": ~covered,
        "moving": covered & foreground,
        "entering": covered & ~foreground & ~inside,
        "disoccluded": covered & ~foreground & inside & ~visible,
    }
    kinds = np.zeros(by_macroblock(covered).shape, np.int8)
    for name in reversed(PRECEDENCE):
        kinds[by_macroblock(pixels[name]) >= SHARE] = KINDS.index(name)
    return kinds


def _in_previous_view(previous: Camera, seen: PosedDepth) -> tuple[F64, F64, F64]:
    """Return where the surface of each pixel lies in the previous view: (u, v) in pixels, depth."""
    k = seen.camera.intrinsics
    height, width = seen.depth.shape
    rays = np.stack(
        [
            *np.meshgrid(
                (np.arange(width) + 0.5 - k.cx_px) / k.fx_px,
                (np.arange(height) + 0.5 - k.cy_px) / k.fy_px,
            ),
            np.ones((height, width)),
        ],
        axis=-1,
    )
    points = rays * seen.depth[..., None].astype(np.float64)
    previous_from_now = previous.cam_from_world().compose(seen.camera.world_from_cam)
    rotation = np.array(previous_from_now.rotation_matrix())
    moved = points @ rotation.T + np.array(previous_from_now.translation_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = k.fx_px * moved[..., 0] / moved[..., 2] + k.cx_px - 0.5
        v = k.fy_px * moved[..., 1] / moved[..., 2] + k.cy_px - 0.5
    return u, v, moved[..., 2]
