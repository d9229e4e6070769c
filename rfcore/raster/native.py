"""The native rasterizer, which everything but tests uses.

The same function as ``rfcore.raster.reference``, whose docstrings define it, in float32 and
bit-exact: the same Gaussians and camera give the same bytes on every instruction set, for every
number of threads and on OpenCL devices (``rfcore.raster.opencl``), which count as one more
instruction set here: ``opencl`` or ``opencl:DEVICE``.

What float32 cannot express is not drawn: Gaussians nearer than 0.01 m or beyond 1e9 m along the
optical axis, or wider than 1e9 px in the picture. Colours are limited to 0..1e18. A quaternion
shorter than 1e-12 counts as no rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import structlog

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native import _native
from rfcore.native.backend import camera_numbers, check_backend
from rfcore.native.yuv import field_view_from_view
from rfcore.raster.gaussians import F32, Gaussians
from rfcore.raster.renderers import DEVICES, is_opencl
from rfcore.views import FieldView, HeldFieldView, View

if TYPE_CHECKING:
    from rfcore.raster.opencl.device import LentBuffer
    from rfcore.raster.opencl.renderer import DeviceRasterizer, DrawnPlane

log = structlog.get_logger()


@dataclass(frozen=True)
class RasterStatistics:
    """Work of one picture, counted by the same loop that draws it."""

    visible: int
    """Gaussians that could colour a pixel."""
    tile_entries: int
    """Overlaps of Gaussians and 16x16 tiles."""
    tile_entries_visited: int
    """Overlaps visited before their tile was opaque."""
    useful_blends: int
    """(pixel, Gaussian) pairs that changed the picture."""
    evaluated_blends: int
    """Lanes evaluated for them."""
    blends_per_px: float
    """Useful blends per pixel."""


def native_camera(camera: Camera) -> _native.RasterCamera:
    """Return the camera in the kernels' form: float32, rounded once; the position as two
    numbers."""
    k = camera.intrinsics
    rotation = camera.cam_from_world().rotation_matrix()
    numbers = camera_numbers(rotation, camera.world_from_cam.translation_m, k)
    return _native.RasterCamera(numbers, k.width_px, k.height_px)


def bands_to_use(sh_degree: int | None, stored: int) -> int:
    """Return the SH degree to evaluate: ``sh_degree``, or all ``stored`` bands for None.

    Raises ``InvalidInput`` for one outside 0..``stored``.
    """
    degree = stored if sh_degree is None else sh_degree
    if not 0 <= degree <= stored:
        raise InvalidInput("sh_degree", f"{degree} is outside 0..{stored}, what the field has")
    return degree


@contextmanager
def overlaps_limited() -> Iterator[None]:
    """Turn the kernels' refusal of too many overlaps into ``InvalidInput``."""
    try:
        yield
    except InvalidInput:
        raise
    except ValueError as error:
        raise InvalidInput("gaussians", str(error)) from error


def check_renderer(threads: int, isa: str | None) -> str:
    """Return the checked instruction set or OpenCL device, which is opened and tested.

    Raises ``BackendUnavailable`` also for a device whose bytes are not those of the CPU.
    """
    if isa is None or not is_opencl(isa):
        return check_backend(threads, isa)
    from rfcore.raster.opencl.self_check import open_device

    check_backend(threads, None)
    open_device(isa.partition(":")[2])
    return isa


class Rasterizer:
    """A copy of one set of Gaussians, ready to be rendered; may be shared between threads.

    The CPU draws for several threads at the same time, an OpenCL device one picture after another.
    ``isa`` forces one of ``available_isas()`` (default: the best) or an OpenCL device; ``threads``
    is 1..256. Neither changes a byte of any picture. ``antialiased`` must be what the Gaussians
    were trained with. Raises ``BackendUnavailable`` or ``InvalidInput``. Rendering raises
    ``InvalidInput`` when the Gaussians overlap more than 2^28 regions of 64x64 pixels, and for an
    ``sh_degree`` they lack.

    When an OpenCL device fails, the CPU draws that picture and all later ones, and redraws planes
    that only the device held. ``isa`` changes accordingly, and a line is logged.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        *,
        threads: int = 1,
        isa: str | None = None,
        antialiased: bool = False,
    ) -> None:
        self.isa = check_renderer(threads, isa)
        self.threads = threads
        self.antialiased = antialiased
        self.sh_degree = gaussians.sh_degree
        self._lock = Lock()
        self._gaussians: Gaussians | None = None
        self._cpu: _native.Rasterizer | None = None
        self._device: DeviceRasterizer | None = None
        if is_opencl(self.isa):
            self._gaussians = gaussians
            self._move_to_device()
        else:
            self._cpu = self._native_rasterizer(gaussians, self.isa)

    def with_threads(self, threads: int) -> Rasterizer:
        """Return an independent renderer of the same Gaussians with so many threads.

        On the CPU the Gaussians are shared, on an OpenCL device copied. Raises ``InvalidInput`` for
        another number than 1..256.
        """
        isa = check_renderer(threads, self.isa)
        if self._gaussians is not None:
            return Rasterizer(
                self._gaussians, threads=threads, isa=isa, antialiased=self.antialiased
            )
        own = copy(self)
        own.threads, own._lock = threads, Lock()
        own._cpu = self._on_cpu().with_threads(threads)
        return own

    def render(self, camera: Camera, *, sh_degree: int | None = None) -> View:
        """Render colour, depth and opacity with the bands up to ``sh_degree`` (default: all)."""
        shape = (camera.intrinsics.height_px, camera.intrinsics.width_px)
        view = View(*(np.empty(s, np.float32) for s in ((*shape, 3), shape, shape)))
        self._draw(camera, sh_degree, view.colour, view.depth, view.opacity)
        return view

    def render_colour(self, camera: Camera, *, sh_degree: int | None = None) -> F32:
        """Render only colour [H, W, 3]: the same bytes as ``render``, a little faster."""
        colour = np.empty((camera.intrinsics.height_px, camera.intrinsics.width_px, 3), np.float32)
        self._draw(camera, sh_degree, colour)
        return colour

    def field_view(self, camera: Camera, *, sh_degree: int | None = None) -> FieldView:
        """Render in the form of the codec: as ``render``, with the colours as a codec picture.

        A device makes that picture itself; depth and opacity stay there until the first request.
        """
        made = None if self._device is None else self._view_of_device(camera, sh_degree)
        if made is not None:
            return made
        return field_view_from_view(self.render(camera, sh_degree=sh_degree), camera)

    def statistics(self, camera: Camera) -> RasterStatistics:
        """Count the work of rendering this view on the CPU; it is slower than rendering."""
        seen_from = native_camera(camera)
        with overlaps_limited():
            counts = self._on_cpu().statistics(seen_from)
        pixels = camera.intrinsics.width_px * camera.intrinsics.height_px
        return RasterStatistics(*counts, blends_per_px=counts[3] / pixels)

    def _draw(
        self,
        camera: Camera,
        sh_degree: int | None,
        colour: F32,
        depth: F32 | None = None,
        opacity: F32 | None = None,
    ) -> None:
        seen_from, degree = native_camera(camera), bands_to_use(sh_degree, self.sh_degree)
        with overlaps_limited():
            if self._drawn_by_device(
                lambda device: device.draw(camera, degree, colour, depth, opacity)
            ):
                return
            if depth is None or opacity is None:
                self._on_cpu().render_colour(seen_from, degree, colour)
            else:
                self._on_cpu().render(seen_from, degree, colour, depth, opacity)

    def _view_of_device(self, camera: Camera, sh_degree: int | None) -> FieldView | None:
        """Return the view rendered by the device; None if it cannot."""
        k, degree = camera.intrinsics, bands_to_use(sh_degree, self.sh_degree)
        native_camera(camera)  # raises for what the kernels do not take
        picture = I420.empty((k.width_px, k.height_px))
        planes: list[DrawnPlane] = []
        with overlaps_limited():
            is_drawn = self._drawn_by_device(
                lambda device: planes.extend(device.draw_codec_picture(camera, degree, picture))
            )
        if not is_drawn:
            return None
        depth = _PlaneOnDevice(self, planes[0], lambda: self.render(camera, sh_degree=degree).depth)
        opacity = _PlaneOnDevice(
            self, planes[1], lambda: self.render(camera, sh_degree=degree).opacity
        )
        return HeldFieldView.of(camera, picture, depth, opacity)

    def _drawn_by_device(self, draw: Callable[[DeviceRasterizer], object]) -> bool:
        """Run ``draw`` on the device; return False if there is none or it cannot."""
        if self._device is None:
            return False
        from rfcore.raster.opencl.device import DeviceFull, DeviceLost

        with self._lock:
            if self._device is None:  # lost while another picture was drawn
                return False
            try:
                draw(self._device)
            except DeviceFull as error:
                DEVICES.add_full()
                log.warning("opencl picture drawn by cpu", reason=str(error))
                return False
            except DeviceLost as error:
                self._leave_device(error)
                return False
        return True

    def _move_to_device(self) -> None:
        from rfcore.raster.opencl.device import DeviceLost
        from rfcore.raster.opencl.renderer import DeviceRasterizer
        from rfcore.raster.opencl.self_check import open_device

        assert self._gaussians is not None
        device = open_device(self.isa.partition(":")[2])
        try:
            self._device = DeviceRasterizer(device, self._gaussians, antialiased=self.antialiased)
        except DeviceLost as error:
            self._leave_device(error)

    def _leave_device(self, error: Exception) -> None:
        self._device = None
        self.isa = check_backend(self.threads, None)
        DEVICES.add_lost()
        log.error("opencl device lost", reason=str(error), isa=self.isa)

    def _on_cpu(self) -> _native.Rasterizer:
        """Return the native renderer, which for Gaussians on a device is made at the first call."""
        with self._lock:
            if self._cpu is None:
                assert self._gaussians is not None
                isa = check_backend(self.threads, None)
                self._cpu = self._native_rasterizer(self._gaussians, isa)
            return self._cpu

    def _native_rasterizer(self, g: Gaussians, isa: str) -> _native.Rasterizer:
        arrays = (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)
        return _native.Rasterizer(*arrays, self.threads, isa, self.antialiased)


class _PlaneOnDevice:
    """A ``HeldPlane`` that ``rasterizer`` drew; ``again`` redraws it if the device was lost."""

    def __init__(self, rasterizer: Rasterizer, plane: DrawnPlane, again: Callable[[], F32]) -> None:
        self._rasterizer, self._plane, self._again = rasterizer, plane, again

    def array(self) -> F32:
        plane = self._plane
        if plane.array is None and not self._rasterizer._drawn_by_device(
            lambda device: device.fetch(plane)
        ):
            plane.array = self._again()
        assert plane.array is not None
        return plane.array

    def carry(
        self, previous: I420, minus: I420 | None, before: FieldView, now: FieldView
    ) -> I420 | None:
        other = before.held_depth
        if not isinstance(other, _PlaneOnDevice) or other._plane.device is not self._plane.device:
            return None
        earlier, depth = other._lent(), self._lent()  # stay as they are while they are held here
        if earlier is None or depth is None:
            return None
        from rfcore.raster.opencl.renderer import DeviceWarp

        warp = DeviceWarp(previous, minus, before, now, earlier, depth)
        out = I420.empty(now.render.size_px)
        made = self._rasterizer._drawn_by_device(lambda device: device.carry(warp, out))
        return out if made else None

    def _lent(self) -> LentBuffer | None:
        return None if self._rasterizer._device is None else self._plane.lent
