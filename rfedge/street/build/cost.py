"""What a build will take, from what frames took: processor time and room on the disk.

Measured on a busy 2-core x86-64 machine (AVX-512, 2.5 GHz) with Mitsuba 3.9.1 and LLVM 19; other
machines differ, which is why the progress bar's time left, not this, is to be believed later on.
"""

from __future__ import annotations

from collections.abc import Sequence

from rfedge.durations import time_text
from rfedge.street.render.backend import Backend
from rfedge.street.render.renderer import Quality
from rfedge.street.shots import Shot

__all__ = ["cost_line"]

START_S = 12.0
"""Making the world and compiling kernels, in each worker."""
SAMPLE_US = 2.0
PIXEL_US = 4.0
"""Guides, depth, denoising, writing."""
SCALAR_TIMES = 3.5
PIXEL_BYTES = 3.2
"""Picture, depth, classes and points together."""


def cost_line(
    shots: Sequence[Shot], quality: Quality, backend: Backend, cores: int, workers: int
) -> str:
    """Return one line: how many frames, core time, time on so many cores, room on the disk."""
    pixels = sum(s.camera.intrinsics.width_px * s.camera.intrinsics.height_px for s in shots)
    pixel_us = quality.samples * SAMPLE_US + PIXEL_US
    core_s = 1e-6 * pixels * pixel_us * (1.0 if backend.vectorised else SCALAR_TIMES)
    core_s += START_S * workers
    used = min(cores, workers if not backend.vectorised else cores)
    room_mb = pixels * PIXEL_BYTES / 1e6
    return (
        f"{len(shots)} frames, {quality.samples} samples a pixel: about {time_text(core_s)} of one "
        f"core, {time_text(core_s / used)} on {used}, {room_mb:.0f} MB"
    )
