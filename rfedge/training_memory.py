"""How much memory a training run takes, said before it starts.

The estimate is the sum of what is allocated, for the largest set the run may grow to. The one run
that tests/train/test_training_memory.py measures stays within 15 % of it.
"""

from __future__ import annotations

from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.ngp.shape import FEATURES
from rfcore.train import NgpModel

__all__ = ["available_bytes", "check_memory", "ngp_training_bytes", "splat_training_bytes"]

BASE_BYTES = 350 << 20
"""The interpreter, numpy, OpenCV and the report's libraries."""
FLOATS_OF_GEOMETRY = 11
SETS = 3
"""Parameters and two moments."""
SLACK = 1.25
"""Buffers that grow are allocated a quarter larger than asked for."""
SPLAT_BYTES = 64 + 3 * 16 + 2 * 4 + 8
"""Projected splat, its sort items, its scores, its range of entries."""
ENTRIES_PER_GAUSSIAN = 5
"""Overlaps with tiles of 16x16 pixels; 3 to 4 on the street at 640x360."""
ENTRY_BYTES = 64 + 3 * 4
NGP_CELL_BYTES = 5
"""Of the occupancy grid: a float and a bit, twice while it is built anew."""
NGP_SCRATCH_BYTES = 150 << 20
"""Samples and activations of one batch."""
PICTURE_FLOATS = 9
"""Colour, target, gradient: three channels each."""


def splat_training_bytes(gaussians: int, sh_degree: int, sizes_px: list[tuple[int, int]]) -> int:
    """Return an estimate of the peak for ``gaussians`` and pictures of ``sizes_px``."""
    parameters = 4 * (FLOATS_OF_GEOMETRY + 3 * (sh_degree + 1) ** 2)
    # The set is copied once: when it grows, for a measurement, or for a checkpoint.
    of_gaussians = gaussians * (parameters * (SETS * SLACK + SETS) + SPLAT_BYTES * SLACK)
    of_entries = gaussians * ENTRIES_PER_GAUSSIAN * ENTRY_BYTES * SLACK
    pixels = [width * height for width, height in sizes_px]
    of_pictures = 3 * sum(pixels) + 4 * PICTURE_FLOATS * max(pixels, default=0)
    return BASE_BYTES + int(of_gaussians + of_entries + of_pictures)


def ngp_training_bytes(model: NgpModel, sizes_px: list[tuple[int, int]]) -> int:
    """Return an estimate of the peak for a hash grid and pictures of ``sizes_px``."""
    table = 4 * FEATURES * model.L << model.log2_T
    # Parameters, gradient, two moments, and one copy for a measurement or a checkpoint's four.
    of_grid = 8 * table + NGP_CELL_BYTES * model.occupancy
    pixels = sum(width * height for width, height in sizes_px)
    return BASE_BYTES + NGP_SCRATCH_BYTES + of_grid + 3 * pixels


def available_bytes(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Return the memory that can be had without swapping; None where the system does not say."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return kib[0] << 10 if kib else None


def check_memory(needed: int, available: int | None) -> None:
    """Raise ``InvalidInput`` when a run needs more memory than there is."""
    if available is not None and needed > available:
        raise InvalidInput(
            "training",
            f"needs about {needed / 2**30:.1f} GiB of memory and {available / 2**30:.1f} GiB are "
            "available; take fewer Gaussians, fewer views or a smaller --size",
        )
