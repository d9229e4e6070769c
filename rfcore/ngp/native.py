"""The native hash grid renderer, which everything but tests uses.

The same function as ``rfcore.ngp.reference``, whose docstrings define it, in float32 and bit-exact:
the same field and camera give the same bytes on every instruction set and thread count.
"""

from __future__ import annotations

import numpy as np

from rfcore.camera import Camera
from rfcore.native import _native
from rfcore.native.backend import camera_numbers, check_backend
from rfcore.ngp.shape import F32, NgpParameters, NgpShape
from rfcore.views import View


def ngp_camera(camera: Camera) -> _native.NgpCamera:
    """Return the camera as the kernels take it: float32, rounded once from float64."""
    k, pose = camera.intrinsics, camera.world_from_cam
    numbers = camera_numbers(pose.rotation_matrix(), pose.translation_m, k)
    return _native.NgpCamera(numbers, k.width_px, k.height_px)


class NgpRenderer:
    """A copy of one hash grid field, ready to be rendered; threads may render with it in parallel.

    ``isa`` and ``threads`` as in ``rfcore.raster.native.Rasterizer``: neither changes a byte.
    """

    def __init__(
        self, parameters: NgpParameters, *, threads: int = 1, isa: str | None = None
    ) -> None:
        self.isa = check_backend(threads, isa)
        self.threads = threads
        p, shape = parameters, parameters.shape
        box, grid = native_shape(shape)
        self._native = _native.NgpRenderer(
            box,
            grid,
            shape.grid.array,
            p.occupancy,
            shape.marching.edges_m,
            p.table,
            p.matrices,
            threads,
            self.isa,
        )
        self.samples = 0
        """Samples evaluated for the last picture."""

    def render(self, camera: Camera, samples_per_ray: int | None = None) -> View:
        """Render colour, depth and opacity; see ``reference.render`` for ``samples_per_ray``."""
        shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        view = View(*(np.empty(s, np.float32) for s in ((*shape, 3), shape, shape)))
        seen_from = ngp_camera(camera)
        self.samples = self._native.render(
            seen_from, samples_per_ray or 0, view.colour, view.depth, view.opacity
        )
        return view

    def render_colour(self, camera: Camera, samples_per_ray: int | None = None) -> F32:
        """Render only colour [H, W, 3]: the same bytes as ``render``."""
        colour = np.empty((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), np.float32)
        seen_from = ngp_camera(camera)
        self.samples = self._native.render_colour(seen_from, samples_per_ray or 0, colour)
        return colour


def native_shape(shape: NgpShape) -> tuple[list[float], list[int]]:
    """Return a shape as the kernels take it: box and grid numbers."""
    space = shape.space
    box = [*space.centre_m, *space.half_m, float(space.unbounded)]
    return box, [shape.hidden, shape.grid.T, *shape.occupancy_cells]
