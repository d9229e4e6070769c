"""Time the renderer of an OpenCL device on the synthetic street, beside the CPU's.

Before a size is timed, the device's view of it must have the bytes of the CPU's. Then the two
render in turns, so that their ratio is taken under the same load of the machine. The device's time
is that of a picture in the memory of the host, its way back included. A row names device and driver
in full: PoCL computes on this CPU and says nothing about a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rfcore.camera import Camera
from rfcore.errors import RfedgeError
from rfcore.raster.native import Rasterizer
from rfedge.bench.street import street_camera, street_gaussians
from rfedge.timing import medians_ms

__all__ = ["SIZES_PX", "OpenClRow", "opencl_rows"]

SIZES_PX = ((640, 360), (1920, 1080))
THREADS = 2
"""Of the CPU's renderer."""


@dataclass(frozen=True)
class OpenClRow:
    """One size; times are medians of colour alone, and of colour with depth and opacity."""

    width: int
    height: int
    gaussians: int
    device: str
    """Device, platform, driver and build."""
    device_ms: float
    device_view_ms: float
    isa: str
    threads: int
    """Of the CPU, whose ``native_ms`` stands beside the device's."""
    native_ms: float
    native_view_ms: float
    ratio: float
    """``native_ms`` over ``device_ms``: above 1 the device is faster."""


def opencl_rows(isa: str) -> list[OpenClRow]:
    """Return one row per size; ``isa`` is ``opencl[:DEVICE]``.

    Raises ``BackendUnavailable`` for a device that is missing or refused, and ``RfedgeError`` where
    a byte differs from the CPU's or the device is lost.
    """
    from rfcore.raster.opencl import open_device

    gaussians = street_gaussians()
    description = open_device(isa.partition(":")[2]).description
    device, native = Rasterizer(gaussians, isa=isa), Rasterizer(gaussians, threads=THREADS)
    rows = []
    for width, height in SIZES_PX:
        camera = street_camera(width, height)
        _check_bytes(device, native, camera)
        medians = medians_ms(_calls(device, native, camera))
        rows.append(
            OpenClRow(
                width=width,
                height=height,
                gaussians=len(gaussians),
                device=description,
                device_ms=medians["device"],
                device_view_ms=medians["device view"],
                isa=native.isa,
                threads=THREADS,
                native_ms=medians["native"],
                native_view_ms=medians["native view"],
                ratio=medians["native"] / medians["device"],
            )
        )
        if device.isa != isa:
            raise RfedgeError(f"{description} was lost while it was timed")
    return rows


def _calls(
    device: Rasterizer, native: Rasterizer, camera: Camera
) -> dict[str, Callable[[], object]]:
    return {
        "device": lambda: device.render_colour(camera),
        "device view": lambda: device.render(camera),
        "native": lambda: native.render_colour(camera),
        "native view": lambda: native.render(camera),
    }


def _check_bytes(device: Rasterizer, native: Rasterizer, camera: Camera) -> None:
    got, want = device.render(camera), native.render(camera)
    for name in ("colour", "depth", "opacity"):
        if getattr(got, name).tobytes() != getattr(want, name).tobytes():
            raise RfedgeError(f"the {name} of {device.isa} is not that of {native.isa}")
