"""Every way to draw splats, for tests that take the implementation as an argument."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from rfcore.native.backend import available_isas

if TYPE_CHECKING:
    from rfcore.raster.opencl.device import Device

DEVICE = os.environ.get("RFEDGE_TEST_OPENCL", "Portable")
"""Name of the OpenCL device that tests draw on: PoCL (OpenCL on the CPU), or another.

Debian has PoCL (``make test-system-packages``); the tests fail without it."""
OPENCL = f"opencl:{DEVICE}"


WORST_CASE = "opencl:worst-case"
"""The same with products contracted where the compiler may, its own divisions and square roots, and
subnormals flushed, but for what the kernels do against it; tests/raster/conftest.py opens it."""


GUARDED = "guarded"
"""The device in the build for inexact compilers; for ``opened``."""


def opened(isa: str) -> Device:
    """Return an opened device; ``GUARDED``: the tests' in that build."""
    from rfcore.raster.opencl.device import BUILDS, build_device, find_device
    from rfcore.raster.opencl.self_check import check_device, open_device

    if isa != GUARDED:
        return open_device(isa.partition(":")[2])
    device = build_device(find_device(DEVICE), BUILDS[1])
    check_device(device)
    return device


def until_gone(call: Callable[..., object], left: Iterator[int]) -> Callable[..., object]:
    """Return a kernel, or another call, whose device is removed once ``left`` is exhausted."""
    import pyopencl as cl

    def run(*arguments: object, **named: object) -> object:
        if next(left, None) is None:
            raise cl.RuntimeError("clEnqueueNDRangeKernel failed: DEVICE_NOT_AVAILABLE")
        return call(*arguments, **named)

    return run


def forward_isas() -> list[Any]:
    """Return what ``Rasterizer`` takes as ``isa`` here, what cannot train included."""
    slow = [pytest.param(isa, marks=pytest.mark.slow) for isa in (OPENCL, WORST_CASE)]
    return [*available_isas(), *slow]
