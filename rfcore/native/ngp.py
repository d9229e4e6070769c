"""The compiled hash grid, arrays in and arrays out.

Same function as ``rfcore.ngp.reference``, in float32 and bit-exact: the same field and camera give
the same bytes on every instruction set and for every number of threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.native import _native

__all__ = ["NativeNgpRenderer", "NativeNgpTrainer", "ngp_camera", "table_entries"]

NativeNgpRenderer = _native.NgpRenderer
NativeNgpTrainer = _native.NgpTrainer

FLOAT32_MAX = float(np.finfo(np.float32).max)


def table_entries(level_cells: NDArray[np.int32], hashed_entries: int) -> int:
    """Return the entries of all levels: the vertices of one that fits T, filled up to 16; or T."""
    return _native.ngp_table_entries(level_cells, hashed_entries)


def ngp_camera(camera: Camera) -> _native.NgpCamera:
    """Return the camera as the kernels take it: float32, rounded once from float64."""
    k, pose = camera.intrinsics, camera.world_from_cam
    rotation = [value for row in pose.rotation_matrix() for value in row]
    numbers = [*rotation, *pose.translation_m, k.fx_px, k.fy_px, k.cx_px, k.cy_px]
    if not all(abs(number) <= FLOAT32_MAX for number in numbers):
        raise InvalidInput("camera", "a value is beyond the range of float32; move the tile origin")
    return _native.NgpCamera(numbers, k.width_px, k.height_px)
