"""Two results that must never change: the sender and the receiver may run different versions.

``python tests/ngp/test_native_golden.py`` prints the digests of today's kernels. They may only
change together with ``RENDERER_CONTRACT``, and the change belongs in CHANGELOG.md.
"""

import hashlib

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.native.backend import available_isas
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import (
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    matrix_shapes,
    table_entries,
)
from rfcore.ngp.trainable import NgpRates, RayBatch, TrainableNgp

VIEW_DIGEST = "1eb19561b910760200843ed8e9ad4734"
TRAINED_DIGEST = "973c0b6b3959073ce9457f89c5d4f7f2"


def numbers() -> NgpParameters:
    """Uniform numbers alone: no transcendental function of some numpy decides a byte here."""
    grid = HashGrid(((5, 4, 3), (9, 7, 5), (24, 18, 12), (80, 60, 40)), 10)
    space = Space((0.0, 0.25, 3.0), (2.0, 1.5, 1.0), True)
    shape = NgpShape(grid, space, Marching(0.25, 1.0625, 80), 32, (20, 15, 10))
    rng = np.random.default_rng(2024)
    table = rng.random((table_entries(grid), 2), dtype=np.float32) * 2 - 1
    weights = sum(rows * columns for rows, columns in matrix_shapes(shape))
    matrices = (rng.random(weights, dtype=np.float32) * 2 - 1) * np.float32(0.5)
    occupancy = rng.integers(0, 1 << 32, shape.occupancy_words, dtype=np.uint32)
    return NgpParameters(shape, table, matrices, occupancy)


def camera(width_px: int, height_px: int) -> Camera:
    half = (0.5 * width_px, 0.5 * height_px)
    intrinsics = Intrinsics(width_px, height_px, 0.75 * width_px, 0.75 * width_px, *half)
    return Camera(intrinsics, Pose((0.25, -0.125, -0.5), (1.0, 0.0, 0.0, 0.0)))


def digest(*arrays: np.ndarray) -> str:
    return hashlib.blake2b(b"".join(a.tobytes() for a in arrays), digest_size=16).hexdigest()


def view_digest(isa: str | None = None) -> str:
    view = NgpRenderer(numbers(), isa=isa).render(camera(90, 51))
    hurried = NgpRenderer(numbers(), isa=isa).render_colour(camera(50, 33), 6)
    return digest(view.colour, view.depth, view.opacity, hurried)


def rays(seed: int) -> RayBatch:
    """Rays along one vector, turned into the eight octants."""
    rng = np.random.default_rng(seed)
    directions = np.array([0.28, 0.6, 0.7493997598078078], np.float32) * rng.choice(
        [-1, 1], (64, 3)
    )
    arrays = (rng.random((64, 3)), directions, rng.random(64), rng.random((64, 3)))
    as_floats = (np.ascontiguousarray(a, dtype=np.float32) for a in arrays)
    return RayBatch(*as_floats, rays_per_block=16, samples_per_ray=64)


def trained_digest(isa: str | None = None) -> str:
    cells = np.full(20 * 15 * 10, 0.02, np.float32)
    trainable = TrainableNgp(numbers(), cells, isa=isa)
    for step in range(3):
        trainable.accumulate(rays(step))
        trainable.update(NgpRates())
    trainable.rebuild_occupancy(0.01)
    return digest(*trainable.state().values())


@pytest.mark.parametrize("isa", available_isas())
def test_a_rendered_grid_has_the_committed_bytes(isa):
    assert view_digest(isa) == VIEW_DIGEST


@pytest.mark.parametrize("isa", available_isas())
def test_a_trained_grid_has_the_committed_bytes(isa):
    assert trained_digest(isa) == TRAINED_DIGEST


if __name__ == "__main__":
    print(f'VIEW_DIGEST = "{view_digest()}"\nTRAINED_DIGEST = "{trained_digest()}"')
