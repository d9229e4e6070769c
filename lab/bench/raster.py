"""Time the native renderer on the synthetic street, beside the torch reference.

Before anything is timed, a small picture must follow the reference in float64: every pixel within
1e-5, but for those where an alpha or a transmittance rounds across a threshold.

``raster_rows`` times the colour picture alone, which is what both ends of the codec predict from;
depth and opacity beside it take 7 % longer at 640x360 and 25 % at 1920x1080.

``opencl_rows`` times the renderer of an OpenCL device on the same street, beside the CPU's. Before
a size is timed, the device's view of it must have the bytes of the CPU's. Then the two
render in turns, so that their ratio is taken under the same load of the machine. The device's time
is that of a picture in the memory of the host, its way back included. A row names device and driver
in full: PoCL computes on this CPU and says nothing about a GPU.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter_ns

import numpy as np
from numpy.typing import NDArray

from lab.bench import Rows
from lab.bench.street import street_camera, street_gaussians
from rfcore.camera import Camera
from rfcore.errors import RfedgeError
from rfcore.extras import needs
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfedge.timing import median_ms, medians_ms

OPENCL_SIZES_PX = ((640, 360), (1920, 1080))
CPU_THREADS = os.cpu_count() or 1
"""Threads of the CPU's renderer when it is compared with a device: all there are."""


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
    """Threads of the CPU that ``native_ms`` is of."""
    native_ms: float
    native_view_ms: float
    ratio: float
    """``native_ms`` over ``device_ms``: above 1 the device is faster."""


def opencl_rows(isa: str) -> list[OpenClRow]:
    """Return one row per size; ``isa`` is ``opencl[:DEVICE]``.

    Raises ``BackendUnavailable`` for a device that is missing or refused, and ``RfedgeError`` where
    a byte differs from the CPU's or the device is lost.
    """
    from rfcore.raster.opencl.self_check import open_device

    gaussians = street_gaussians()
    description = open_device(isa.partition(":")[2]).description
    device, native = Rasterizer(gaussians, isa=isa), Rasterizer(gaussians, threads=CPU_THREADS)
    rows = []
    for width, height in OPENCL_SIZES_PX:
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
                threads=CPU_THREADS,
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
        "device view": lambda: device.field_view(camera),
        "native": lambda: native.render_colour(camera),
        "native view": lambda: native.field_view(camera),
    }


def _check_bytes(device: Rasterizer, native: Rasterizer, camera: Camera) -> None:
    got, want = device.render(camera), native.render(camera)
    for name in ("colour", "depth", "opacity"):
        if getattr(got, name).tobytes() != getattr(want, name).tobytes():
            raise RfedgeError(f"the {name} of {device.isa} is not that of {native.isa}")
    if device.field_view(camera).render.digest() != native.field_view(camera).render.digest():
        raise RfedgeError(f"the codec's picture of {device.isa} is not that of {native.isa}")


SIZES_PX = ((300, 168), (640, 360), (1280, 720), (1920, 1080))
THREADS = (1, 2)
REFERENCE_SIZES_PX = ((300, 168), (640, 360))
"""The reference takes tens of seconds beyond; it is run once a size."""
CHECK_SIZE_PX = (96, 54)
TOLERANCE = 1e-5
MAX_FLIPPED = 0.01
"""Share of pixels that may differ by more: each takes about 50 comparisons with a threshold."""


@dataclass(frozen=True)
class RasterRow:
    """One size and number of threads; times are medians, None where the reference was not run."""

    width: int
    height: int
    gaussians: int
    visible: int
    blends_per_px: float
    threads: int
    isa: str
    native_ms: float
    reference_ms: float | None
    max_abs_error: float | None
    """Largest difference of a colour from the reference, of a range of 0..1."""


def raster_rows(rows: Rows = "all") -> list[RasterRow]:
    """Return one row per size and number of threads; ``native`` leaves the reference out.

    Raises ``RfedgeError`` when the renderer is wrong.
    """
    gaussians = _checked_street()
    rasterizers = [Rasterizer(gaussians, threads=threads) for threads in THREADS]
    result = []
    for size in SIZES_PX:
        reference_ms, error = None, None
        if rows == "all" and size in REFERENCE_SIZES_PX:
            reference_ms, error = _against_reference(gaussians, rasterizers[0], size)
        for rasterizer in rasterizers:
            row = _native_row(rasterizer, size, len(gaussians))
            result.append(replace(row, reference_ms=reference_ms, max_abs_error=error))
    return result


def _checked_street() -> Gaussians:
    gaussians = street_gaussians()
    check_against_reference(gaussians, street_camera(*CHECK_SIZE_PX))
    return gaussians


def check_against_reference(gaussians: Gaussians, camera: Camera) -> None:
    """Raise ``RfedgeError`` unless the native colours follow the float64 reference."""
    got = Rasterizer(gaussians).render_colour(camera)
    error = np.abs(got - _reference_colour(gaussians, camera)).max(axis=2)
    flipped = float((error > TOLERANCE).mean())
    if not flipped <= MAX_FLIPPED:
        raise RfedgeError(
            f"the native renderer is off by up to {error.max():.2g} from the reference on "
            f"{flipped:.2%} of the pixels (limit {MAX_FLIPPED:.0%}): nothing was timed"
        )


def _reference_colour(gaussians: Gaussians, camera: Camera) -> NDArray[np.float64]:

    from rfcore.raster import reference

    with needs("reference"):
        import torch

    with torch.no_grad():
        colour, _, _ = reference.render(reference.parameters(gaussians), camera)
    picture: NDArray[np.float64] = colour.numpy()
    return picture


def _native_row(rasterizer: Rasterizer, size: tuple[int, int], count: int) -> RasterRow:
    camera = street_camera(*size)
    statistics = rasterizer.statistics(camera)
    return RasterRow(
        width=size[0],
        height=size[1],
        gaussians=count,
        visible=statistics.visible,
        blends_per_px=round(statistics.blends_per_px, 3),
        threads=rasterizer.threads,
        isa=rasterizer.isa,
        native_ms=median_ms(lambda: rasterizer.render_colour(camera)),
        reference_ms=None,
        max_abs_error=None,
    )


def _against_reference(
    gaussians: Gaussians, rasterizer: Rasterizer, size: tuple[int, int]
) -> tuple[float, float]:
    """Return the reference's duration in ms and the largest difference of a colour."""
    camera = street_camera(*size)
    start = perf_counter_ns()
    want = _reference_colour(gaussians, camera)
    reference_ms = (perf_counter_ns() - start) / 1e6
    return reference_ms, float(np.abs(rasterizer.render_colour(camera) - want).max())
