"""The native rasterizer: what everything but tests and training renders with.

The same function as ``rfcore.raster.reference``, whose docstrings define it.
"""

from __future__ import annotations

from rfcore.camera import Camera
from rfcore.native.raster import (
    GaussianArrays,
    NativeRasterizer,
    RasterStatistics,
    available_isas,
)
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.views import View

__all__ = ["RasterStatistics", "Rasterizer", "available_isas"]


class Rasterizer:
    """A copy of one set of Gaussians, ready to be rendered; may be shared between threads.

    ``isa`` forces one of ``available_isas()`` (default: the best); ``threads`` is 1..256. Neither
    changes a byte of any picture. Raises ``BackendUnavailable`` or ``InvalidInput``.
    """

    def __init__(self, gaussians: Gaussians, *, threads: int = 1, isa: str | None = None) -> None:
        self._native = NativeRasterizer(_arrays(gaussians), threads=threads, isa=isa)

    @property
    def isa(self) -> str:
        """The instruction set in use."""
        return self._native.isa

    @property
    def threads(self) -> int:
        """Number of threads in use."""
        return self._native.threads

    def render(self, camera: Camera) -> View:
        """Render colour, depth and opacity from ``camera``."""
        return View(*self._native.render(camera))

    def render_colour(self, camera: Camera) -> F32:
        """Render colour [H, W, 3] alone: the same bytes as ``render``'s, a little sooner."""
        return self._native.render_colour(camera)

    def statistics(self, camera: Camera) -> RasterStatistics:
        """Count what rendering this view takes."""
        return self._native.statistics(camera)


def _arrays(gaussians: Gaussians) -> GaussianArrays:
    g = gaussians
    return (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)
