"""The compiled 3D Gaussian Splatting rasterizer, arrays in and arrays out.

Same function as ``rfcore.raster.reference``, in float32 and bit-exact: the same Gaussians and
camera give the same bytes on every instruction set and for every number of threads.

What float32 cannot express is not drawn: Gaussians nearer than 0.01 m or beyond 1e9 m along the
optical axis, or wider than 1e9 px in the picture. Colours are limited to 0..1e18. A quaternion
shorter than 1e-12 counts as no rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfcore.camera import Camera
from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.native import _native

__all__ = [
    "MAX_THREADS",
    "NativeRasterizer",
    "NativeTrainable",
    "RasterStatistics",
    "available_isas",
    "bands_to_use",
    "check_backend",
    "native_camera",
    "overlaps_limited",
]

NativeRasterizer = _native.Rasterizer
NativeTrainable = _native.TrainableRasterizer

MAX_THREADS = 256
FLOAT32_MAX = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class RasterStatistics:
    """What one picture cost, counted by the same loop that draws it."""

    visible: int
    """Gaussians that could colour a pixel."""
    tile_entries: int
    """Overlaps of Gaussians and 16x16 tiles."""
    tile_entries_visited: int
    """Those looked at before their tile was opaque."""
    useful_blends: int
    """(pixel, Gaussian) pairs that changed the picture."""
    evaluated_blends: int
    """Lanes evaluated for them."""
    blends_per_px: float
    """Useful blends per pixel."""


def available_isas() -> tuple[str, ...]:
    """Return the instruction sets this machine can run, best first, ``scalar`` last."""
    return tuple(_native.available_isas())


def check_backend(threads: int, isa: str | None) -> str:
    """Return the instruction set to use.

    Raises ``BackendUnavailable`` for one this machine lacks, ``InvalidInput`` for a number of
    threads outside 1..256.
    """
    if not 1 <= threads <= MAX_THREADS:
        raise InvalidInput("threads", f"{threads} is outside 1..{MAX_THREADS}")
    present = available_isas()
    if isa is not None and isa not in present:
        raise BackendUnavailable(
            f"instruction set {isa!r} is not available here; choose from {', '.join(present)}"
        )
    return present[0] if isa is None else isa


def native_camera(camera: Camera) -> _native.RasterCamera:
    """Return the camera as the kernels take it: float32, rounded once; the position as two."""
    k = camera.intrinsics
    rotation = [value for row in camera.cam_from_world().rotation_matrix() for value in row]
    numbers = [*rotation, *camera.world_from_cam.translation_m]
    numbers += [k.fx_px, k.fy_px, k.cx_px, k.cy_px]
    if not all(abs(number) <= FLOAT32_MAX for number in numbers):
        raise InvalidInput("camera", "a value is beyond the range of float32; move the tile origin")
    return _native.RasterCamera(numbers, k.width_px, k.height_px)


def bands_to_use(sh_degree: int | None, stored: int) -> int:
    """Return the SH degree to evaluate: ``sh_degree``, or all ``stored`` bands for None.

    Raises ``InvalidInput`` for one outside 0..``stored``.
    """
    degree = stored if sh_degree is None else sh_degree
    if not 0 <= degree <= stored:
        raise InvalidInput("sh_degree", f"{degree} is outside 0..{stored}, what the field has")
    return degree


class overlaps_limited:  # noqa: N801 - reads as a condition in a with statement
    """Turn the kernels' refusal of too many overlaps into ``InvalidInput``."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError) and not isinstance(error, InvalidInput):
            raise InvalidInput("gaussians", str(error)) from error
