"""Every way to draw splats, for tests that take the implementation as an argument."""

from typing import Any

import pytest

from rfcore.native.backend import available_isas

POCL = "opencl:Portable"
"""OpenCL on the CPU. Debian has it (``make test-system-packages``); its tests fail without it."""


WORST_CASE = "opencl:worst-case"
"""The same with products contracted where the compiler may, its own divisions and square roots, and
subnormals flushed, but for what the kernels do against it; tests/raster/conftest.py opens it."""


def forward_isas() -> list[Any]:
    """Return what ``Rasterizer`` takes as ``isa`` here, what cannot train included."""
    slow = [pytest.param(isa, marks=pytest.mark.slow) for isa in (POCL, WORST_CASE)]
    return [*available_isas(), *slow]
