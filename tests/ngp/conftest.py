"""Small fields of every shape the kernels know, and every way to run them."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.backend import available_isas
from rfcore.ngp.shape import (
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    grid_levels,
    initial_parameters,
)


def numbers(
    *,
    unbounded: bool = True,
    levels: int = 5,
    log2_T: int = 8,
    hidden: int = 16,
    steps_per_doubling: int = 9,
    occupied_share: float = 1.0,
    table_range: float = 1.0,
    seed: int = 0,
) -> NgpParameters:
    """Return a field in a box of 4 x 3 x 2 m whose colours and densities vary strongly."""
    space = Space((0.25, -0.5, 2.0), (2.0, 1.5, 1.0), unbounded)
    grid = HashGrid(grid_levels(levels, 3, 40, space.aspect), log2_T)
    marching = Marching.between(0.25, 12.0, steps_per_doubling)
    shape = NgpShape(grid, space, marching, hidden, (9, 7, 5))
    rng = np.random.default_rng(seed)
    occupied = rng.random(9 * 7 * 5) < occupied_share
    bits = np.zeros(32 * shape.occupancy_words, bool)
    bits[: occupied.size] = occupied
    words = np.packbits(bits, bitorder="little").view(np.uint32)
    start = initial_parameters(shape, words, rng)
    table = rng.random(start.table.shape, dtype=np.float32) * 2 - 1
    return NgpParameters(shape, table * np.float32(table_range), start.matrices, words)


def camera(width_px: int = 37, height_px: int = 21) -> Camera:
    """Return a camera that looks along z into the box, off-centre principal point."""
    intrinsics = Intrinsics(
        width_px, height_px, 0.7 * width_px, 0.72 * width_px, 0.47 * width_px, 0.55 * height_px
    )
    rotation = np.array([0.9979, 0.03, -0.05, 0.02])
    w, x, y, z = (rotation / np.sqrt(np.sum(rotation**2))).tolist()
    return Camera(intrinsics, Pose((0.1, -0.4, 0.3), (w, x, y, z)))


@pytest.fixture(params=available_isas())
def isa(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> int:
    return int(request.param)
