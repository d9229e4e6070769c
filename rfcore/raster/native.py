"""The native rasterizer: what everything but tests renders with.

The same function as ``rfcore.raster.reference``, whose docstrings define it, in float32 and
bit-exact: the same Gaussians and camera give the same bytes on every instruction set and for every
number of threads.

What float32 cannot express is not drawn: Gaussians nearer than 0.01 m or beyond 1e9 m along the
optical axis, or wider than 1e9 px in the picture. Colours are limited to 0..1e18. A quaternion
shorter than 1e-12 counts as no rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import numpy as np

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.native import _native
from rfcore.native.backend import FLOAT32_MAX, check_backend
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.views import View

__all__ = [
    "RasterStatistics",
    "Rasterizer",
    "bands_to_use",
    "native_camera",
    "overlaps_limited",
]


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


class Rasterizer:
    """A copy of one set of Gaussians, ready to be rendered; may be shared between threads.

    ``isa`` forces one of ``available_isas()`` (default: the best); ``threads`` is 1..256. Neither
    changes a byte of any picture. ``antialiased`` must be what the Gaussians were trained with.
    Raises ``BackendUnavailable`` or ``InvalidInput``. Rendering raises ``InvalidInput`` when the
    Gaussians overlap more than 2^28 regions of 64x64 pixels, and for an ``sh_degree`` they lack.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        *,
        threads: int = 1,
        isa: str | None = None,
        antialiased: bool = False,
    ) -> None:
        self.isa = check_backend(threads, isa)
        self.threads = threads
        self.antialiased = antialiased
        self.sh_degree = gaussians.sh_degree
        g = gaussians
        arrays = (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)
        self._native = _native.Rasterizer(*arrays, threads, self.isa, antialiased)
        self._lock = Lock()

    def render(self, camera: Camera, *, sh_degree: int | None = None) -> View:
        """Render colour, depth and opacity with the bands up to ``sh_degree`` (default: all)."""
        shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        view = View(*(np.empty(s, np.float32) for s in ((*shape, 3), shape, shape)))
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with self._lock, overlaps_limited():
            self._native.render(seen_from, degree, view.colour, view.depth, view.opacity)
        return view

    def render_colour(self, camera: Camera, *, sh_degree: int | None = None) -> F32:
        """Render colour [H, W, 3] alone: the same bytes as ``render``'s, a little sooner."""
        colour = np.empty((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), np.float32)
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with self._lock, overlaps_limited():
            self._native.render_colour(seen_from, degree, colour)
        return colour

    def statistics(self, camera: Camera) -> RasterStatistics:
        """Count what rendering this view takes; slower than rendering it."""
        seen_from = native_camera(camera)
        with self._lock, overlaps_limited():
            counts = self._native.statistics(seen_from)
        pixels = camera.intrinsics.width_px * camera.intrinsics.height_px
        return RasterStatistics(*counts, blends_per_px=counts[3] / pixels)
