"""The hash grid's kernels on another architecture: the same bytes, drawing and training."""

import struct
from dataclasses import astuple, dataclass
from math import prod

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import (
    HashGrid,
    Marching,
    NgpParameters,
    NgpShape,
    Space,
    grid_levels,
    initial_parameters,
)
from rfcore.ngp.trainable import NgpRates, RayBatch, TrainableNgp

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.timeout(900)]


STEPS, RATES, THRESHOLD = 3, NgpRates(), 0.01
CAMERA = Camera(
    Intrinsics(21, 13, 15.0, 15.5, 10.0, 7.0), Pose((0.1, -0.4, 0.3), (0.96, 0.0, 0.28, 0.0))
)


@dataclass(frozen=True)
class Scene:
    """The scene that both machines draw and train."""

    field: NgpParameters
    peaks: np.ndarray
    batch: RayBatch
    samples_per_ray: int

    def to_bytes(self) -> bytes:
        f, shape, k, batch = self.field, self.field.shape, CAMERA.intrinsics, self.batch
        sizes = (
            *(shape.grid.L, shape.hidden, shape.grid.T, *shape.occupancy_cells),
            *(shape.marching.steps, shape.space.unbounded, k.width_px, k.height_px),
            *(self.samples_per_ray, len(batch.jitter), batch.rays_per_block),
            *(batch.samples_per_ray, STEPS),
        )
        rates = astuple(RATES)
        rotation = np.array(CAMERA.world_from_cam.rotation_matrix()).ravel()
        numbers = (
            *(*shape.space.centre_m, *shape.space.half_m, *rotation),
            *(*CAMERA.world_from_cam.translation_m, k.fx_px, k.fy_px, k.cx_px, k.cy_px),
            *(*rates[:6], rates[6]),
        )
        arrays = (
            *(shape.grid.array, f.occupancy, shape.marching.edges_m, f.table, f.matrices),
            *(self.peaks, batch.origins, batch.directions, batch.jitter, batch.targets),
        )
        header = struct.pack("<15i29f", *map(int, sizes), *numbers)
        return header + b"".join(array.tobytes() for array in arrays)


def scene(unbounded: bool, samples_per_ray: int) -> Scene:
    """Colours and densities that vary strongly; entries up to 30 make some of them overflow."""
    space = Space((0.25, -0.5, 2.0), (2.0, 1.5, 1.0), unbounded)
    grid = HashGrid(grid_levels(6, 3, 60, space.aspect), 9)
    shape = NgpShape(grid, space, Marching.between(0.25, 12.0, 9), 32, (9, 7, 5))
    rng = np.random.default_rng(3)
    words = rng.integers(0, 1 << 32, shape.occupancy_words, dtype=np.uint32)
    numbers = initial_parameters(shape, words, rng)
    table = (rng.random(numbers.table.shape, dtype=np.float32) * 2 - 1) * np.float32(2)
    table[::50] *= 15
    field = NgpParameters(shape, table, numbers.matrices, words)
    peaks = rng.random(prod(shape.occupancy_cells), dtype=np.float32)
    return Scene(field, peaks, rays(rng), samples_per_ray)


def rays(rng: np.random.Generator, count: int = 70) -> RayBatch:
    directions = rng.random((count, 3)) * [0.8, 0.6, 0.2] + [-0.4, -0.3, 0.9]
    directions /= np.sqrt(np.sum(directions**2, axis=1, keepdims=True))
    arrays = (rng.random((count, 3)) * 0.2, directions, rng.random(count), rng.random((count, 3)))
    as_floats = (np.ascontiguousarray(a, dtype=np.float32) for a in arrays)
    return RayBatch(*as_floats, rays_per_block=16, samples_per_ray=60)


def drawn(made: Scene) -> bytes:
    view = NgpRenderer(made.field).render(CAMERA, made.samples_per_ray or None)
    return view.colour.tobytes() + view.depth.tobytes() + view.opacity.tobytes()


def trained(made: Scene) -> bytes:
    trainable = TrainableNgp(made.field, made.peaks)
    losses = []
    for _ in range(STEPS):
        losses.append(trainable.accumulate(made.batch))
        trainable.update(RATES)
        trainable.rebuild_occupancy(THRESHOLD)
    state = trainable.state()
    arrays = (state[name] for name in ("table", "matrices", "occupancy"))
    return struct.pack(f"<{STEPS}d", *losses) + b"".join(array.tobytes() for array in arrays)


@pytest.mark.parametrize(("isa", "threads"), [("neon", 1), ("neon", 3), ("scalar", 2)])
@pytest.mark.parametrize(("unbounded", "samples_per_ray"), [(False, 0), (True, 6)])
def test_aarch64_draws_and_trains_a_hash_grid_to_the_same_bytes(
    emulated, first_difference, isa, threads, unbounded, samples_per_ray
):
    made = scene(unbounded, samples_per_ray)
    there = emulated("exactness_ngp", isa, threads, made.to_bytes())
    assert first_difference(there, drawn(made) + trained(made)) is None
