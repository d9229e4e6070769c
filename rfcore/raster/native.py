"""The native rasterizer: what everything but tests renders and trains with.

The same function as ``rfcore.raster.reference``, whose docstrings define it; what float32 adds to
the definition is in ``rfcore.native.raster``.
"""

from __future__ import annotations

from threading import Lock

import numpy as np

from rfcore.camera import Camera
from rfcore.native.raster import (
    NativeRasterizer,
    RasterStatistics,
    available_isas,
    bands_to_use,
    check_backend,
    native_camera,
    overlaps_limited,
)
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.trainable import (
    DensityStep,
    Exposure,
    LearningRates,
    TrainableRasterizer,
    TrainingState,
)
from rfcore.views import View

__all__ = [
    "DensityStep",
    "Exposure",
    "LearningRates",
    "RasterStatistics",
    "Rasterizer",
    "TrainableRasterizer",
    "TrainingState",
    "available_isas",
]


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
        self._native = NativeRasterizer(*arrays, threads, self.isa, antialiased)
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
