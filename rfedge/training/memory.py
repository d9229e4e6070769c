"""The memory that a training run takes, said before it starts.

The estimate is the sum of all allocations for the largest set of primitives that the run may grow
to. tests/train/test_training_memory.py compares it with a run: it is within 15 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.ngp.shape import FEATURES
from rfcore.train.ngp import NgpModel, NgpTrainingConfig
from rfcore.train.splats import SplatTrainingConfig

Size = tuple[int, int]
"""Width and height of a picture in pixels."""

BASE_BYTES = 350 << 20
"""Memory of the interpreter, numpy, PyAV, the report's libraries and the neighbour search."""
FLOATS_OF_GEOMETRY = 11
SETS = 3
"""Number of copies of the parameters: themselves and two moments."""
SLACK = 1.25
"""Buffers that grow are allocated a quarter larger than asked for."""
SPLAT_BYTES = 64 + 3 * 16 + 2 * 4 + 8
"""Projected splat, its sort items, its scores, its range of entries."""
ENTRIES_PER_GAUSSIAN = 5
"""Overlaps with tiles of 16x16 pixels; 3 to 4 on the street at 640x360."""
ENTRY_BYTES = 64 + 3 * 4
NGP_CELL_BYTES = 5
"""Bytes of a cell of the occupancy grid: a float and a bit, twice while it is rebuilt."""
NGP_SCRATCH_BYTES = 150 << 20
"""Samples and activations of one batch."""
PICTURE_FLOATS = 9
"""Floats of a pixel: colour, target and gradient, three channels each."""
FEWEST, ROUND = 10_000, 10_000
"""Gaussians below which a smaller set is no remedy, and what its number is a multiple of."""
SIZE_STEP = 0.95
"""Sizes that are tried as a remedy have this share of the width of the one before."""


def splat_training_bytes(
    gaussians: int, sh_degree: int, sizes_px: Sequence[Size], halvings: int = 0
) -> int:
    """Return an estimate of the peak for ``gaussians`` and pictures of ``sizes_px``."""
    parameters = 4 * (FLOATS_OF_GEOMETRY + 3 * (sh_degree + 1) ** 2)
    # The set is copied once: when it grows, for a measurement, or for a checkpoint.
    of_gaussians = gaussians * (parameters * (SETS * SLACK + SETS) + SPLAT_BYTES * SLACK)
    of_entries = gaussians * ENTRIES_PER_GAUSSIAN * ENTRY_BYTES * SLACK
    pixels = [width * height for width, height in sizes_px]
    copies = sum(0.25**k for k in range(halvings + 1))
    of_pictures = 3 * copies * sum(pixels) + 4 * PICTURE_FLOATS * max(pixels, default=0)
    return BASE_BYTES + int(of_gaussians + of_entries + of_pictures)


def ngp_training_bytes(model: NgpModel, sizes_px: Sequence[Size]) -> int:
    """Return an estimate of the peak for a hash grid and pictures of ``sizes_px``."""
    table = 4 * FEATURES * model.L << model.log2_T
    # Parameters, gradient, two moments, and one copy for a measurement or a checkpoint's four.
    of_grid = 8 * table + NGP_CELL_BYTES * model.occupancy
    pixels = sum(width * height for width, height in sizes_px)
    return BASE_BYTES + NGP_SCRATCH_BYTES + of_grid + 3 * pixels


def most_gaussians(config: SplatTrainingConfig) -> int:
    """Return the most Gaussians that a run can have."""
    return max(config.gaussians + config.sky, config.density.limit)


def training_bytes(
    config: SplatTrainingConfig | NgpTrainingConfig, sizes_px: Sequence[Size]
) -> int:
    """Return an estimate of the peak of a run on pictures of ``sizes_px``."""
    if isinstance(config, NgpTrainingConfig):
        return ngp_training_bytes(config.model, sizes_px)
    halvings = len(config.halved_until)
    return splat_training_bytes(most_gaussians(config), config.bands.degree, sizes_px, halvings)


def available_bytes(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Return the memory available without swapping, or None if the system does not say."""
    try:
        lines = meminfo.read_text().splitlines()
    except OSError:
        return None
    kib = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return kib[0] << 10 if kib else None


def check_memory(
    config: SplatTrainingConfig | NgpTrainingConfig,
    sizes_px: Sequence[Size],
    available: int | None,
) -> None:
    """Raise ``InvalidInput`` when a run needs more memory than there is, with what would fit."""
    needed = training_bytes(config, sizes_px)
    if available is None or needed <= available:
        return
    remedies = [*_fewer(config, sizes_px, available), *_smaller(config, sizes_px, available)]
    remedies = remedies or _both(config, sizes_px, available)
    raise InvalidInput(
        "training",
        f"needs about {needed / 2**30:.1f} GiB of memory and {available / 2**30:.1f} GiB are "
        f"available; what fits: {' or '.join(remedies) or 'fewer pictures (--views-percent)'}",
    )


def _fewer(
    config: SplatTrainingConfig | NgpTrainingConfig, sizes_px: Sequence[Size], available: int
) -> list[str]:
    """Return the options of the largest set of Gaussians that fits, if one does."""
    if isinstance(config, NgpTrainingConfig):
        return []
    for count in range(most_gaussians(config) // ROUND * ROUND, FEWEST - 1, -ROUND):
        start = min(config.gaussians, max(count - config.sky, 1))
        density = replace(config.density, limit=min(config.density.limit, count))
        few = replace(config, gaussians=start, density=density)
        if training_bytes(few, sizes_px) <= available:
            options = [f"--limit {count}"] if density != config.density else []
            options += [f"--gaussians {start}"] if start < config.gaussians else []
            return [" ".join(options)]
    return []


def _both(
    config: SplatTrainingConfig | NgpTrainingConfig, sizes_px: Sequence[Size], available: int
) -> list[str]:
    """Return the options of a smaller size and a smaller set, if those fit together."""
    (width, height), scale = sizes_px[0], 0.5
    while (size := (round(scale * width), round(scale * height))) > (32, 32):
        if few := _fewer(config, [size] * len(sizes_px), available):
            return [f"--size {size[0]}x{size[1]} {few[0]}"]
        scale /= 2
    return []


def _smaller(
    config: SplatTrainingConfig | NgpTrainingConfig, sizes_px: Sequence[Size], available: int
) -> list[str]:
    """Return the option of the largest size of the pictures that fits, if one does."""
    (width, height), scale = sizes_px[0], SIZE_STEP
    while (size := (round(scale * width), round(scale * height))) > (32, 32):
        if training_bytes(config, [size] * len(sizes_px)) <= available:
            return [f"--size {size[0]}x{size[1]}"]
        scale *= SIZE_STEP
    return []
