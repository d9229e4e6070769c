"""Helpers of all kernels: the instruction sets of this machine, limits, and cameras as numbers."""

from __future__ import annotations

import numpy as np

from rfcore.camera import Intrinsics, Mat3, Vec3
from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.native import _native

MAX_THREADS = 256
FLOAT32_MAX = float(np.finfo(np.float32).max)


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


def camera_numbers(rotation: Mat3, translation_m: Vec3, k: Intrinsics) -> list[float]:
    """Return a camera as kernels take it: rotation (9, row-major), translation (3), fx, fy, cx, cy.

    Raises ``InvalidInput`` for a number that float32 does not hold.
    """
    numbers = [value for row in rotation for value in row]
    numbers += [*translation_m, k.fx_px, k.fy_px, k.cx_px, k.cy_px]
    if not all(abs(number) <= FLOAT32_MAX for number in numbers):
        raise InvalidInput("camera", "a value is beyond the range of float32; move the tile origin")
    return numbers
