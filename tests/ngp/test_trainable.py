"""Training on the native kernels: gradients of the definition, deterministic steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rfcore.errors import InvalidInput
from rfcore.ngp import reference
from rfcore.ngp.shape import NgpParameters
from rfcore.ngp.trainable import NgpRates, RayBatch, TrainableNgp
from tests.ngp.conftest import numbers

GRADIENT_TOLERANCE = 1e-4


def rays(count: int = 50, seed: int = 1) -> RayBatch:
    """Rays from around the camera's place into the box."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3)) * [0.4, 0.3, 0.1] + [0, 0, 1]
    directions /= np.sqrt(np.sum(directions**2, axis=1, keepdims=True))
    origins = rng.normal(size=(count, 3)) * 0.1
    arrays = (origins, directions, rng.random(count), rng.random((count, 3)))
    as_floats = (np.ascontiguousarray(a, dtype=np.float32) for a in arrays)
    return RayBatch(*as_floats, rays_per_block=16, samples_per_ray=200)


def peaks(field: NgpParameters, value: float = 1.0) -> np.ndarray:
    return np.full(np.prod(field.shape.occupancy_cells), value, np.float32)


def reference_loss(params: dict[str, torch.Tensor], field: NgpParameters, batch: RayBatch):
    as_tensors = (
        torch.tensor(a, dtype=torch.float64)
        for a in (batch.origins, batch.directions, batch.jitter)
    )
    colour, _, _ = reference.render_rays(
        params, field, reference.Rays(*as_tensors), most_samples=batch.samples_per_ray
    )
    return ((colour - torch.tensor(batch.targets, dtype=torch.float64)) ** 2).mean()


def relative_error(got: np.ndarray, want: np.ndarray) -> float:
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


def state_bytes(trainable: TrainableNgp) -> bytes:
    return b"".join(array.tobytes() for array in trainable.state().values())


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize(("levels", "hidden"), [(1, 16), (5, 32), (9, 48), (16, 64)])
@pytest.mark.parametrize("samples_per_ray", [200, 11])
def test_loss_and_gradients_follow_the_float64_definition(
    unbounded, levels, hidden, samples_per_ray
):
    field = numbers(unbounded=unbounded, levels=levels, hidden=hidden)
    batch = replace(rays(), samples_per_ray=samples_per_ray)
    params = reference.parameters(field, requires_grad=True)
    want = reference_loss(params, field, batch)
    want.backward()
    trainable = TrainableNgp(field, peaks(field))
    assert trainable.accumulate(batch) == pytest.approx(float(want.detach()), rel=1e-5)
    table, matrices = trainable.gradients()
    assert relative_error(table, params["table"].grad.numpy()) < GRADIENT_TOLERANCE
    wanted = np.concatenate([params[f"W{i}"].grad.numpy().ravel() for i in range(5)])
    assert relative_error(matrices, wanted) < GRADIENT_TOLERANCE


def test_gradients_are_the_finite_differences_of_the_definition():
    field, batch = numbers(levels=3), rays(12)
    trainable = TrainableNgp(field, peaks(field))
    trainable.accumulate(batch)
    table, matrices = trainable.gradients()
    direction = np.random.default_rng(3).normal(size=table.size + matrices.size)
    direction[: table.size] *= table.ravel() != 0
    slope = float(np.concatenate([table.ravel(), matrices]) @ direction)
    losses = []
    for step in (1e-6, -1e-6):
        params = reference.parameters(field)
        with torch.no_grad():
            moved = torch.tensor(step * direction)
            params["table"] += moved[: table.size].reshape(-1, 2)
            parts = torch.split(moved[table.size :], [params[f"W{i}"].numel() for i in range(5)])
            for i, part in enumerate(parts):
                params[f"W{i}"] += part.reshape(params[f"W{i}"].shape)
            losses.append(float(reference_loss(params, field, batch)))
    assert slope == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=2e-3)


def trained(field: NgpParameters, isa: str | None, threads: int, steps: int = 4) -> TrainableNgp:
    trainable = TrainableNgp(field, peaks(field, 0.02), isa=isa, threads=threads)
    for step in range(steps):
        trainable.accumulate(rays(70, seed=step))
        trainable.update(NgpRates())
        trainable.rebuild_occupancy(0.01)
    return trainable


def test_every_instruction_set_and_thread_count_trains_the_same_bytes(isa, threads):
    field = numbers(hidden=32)
    definition = trained(field, "scalar", 1)
    assert state_bytes(trained(field, isa, threads)) == state_bytes(definition)


def test_steps_lower_the_loss_of_a_batch():
    field, batch = numbers(table_range=1e-4), rays(200)
    trainable = TrainableNgp(field, peaks(field))
    losses = []
    for _ in range(60):
        losses.append(trainable.accumulate(batch))
        trainable.update(NgpRates())
    assert losses[-1] < 0.4 * losses[0]


def test_a_restored_state_goes_on_as_if_nothing_had_happened():
    field = numbers()
    through = trained(field, None, 1, steps=3)
    resumed = TrainableNgp(numbers(seed=9), peaks(field))
    resumed.restore(through.state())
    for trainable in (through, resumed):
        trainable.accumulate(rays(seed=7))
        trainable.update(NgpRates())
    assert state_bytes(resumed) == state_bytes(through)


def test_entries_no_sample_touches_stay_with_their_moments():
    field = numbers(log2_T=14)
    trainable = TrainableNgp(field, peaks(field))
    batch = rays(8)
    trainable.accumulate(batch)
    table, _ = trainable.gradients()
    trainable.accumulate(batch)
    trainable.update(NgpRates())
    after = trainable.state()
    untouched = table.ravel() == 0
    assert 0.3 < untouched.mean() < 1
    assert np.array_equal(after["table"][untouched], field.table.ravel()[untouched])
    assert not after["table_m"][untouched].any()


def test_cells_seen_empty_are_emptied_and_others_kept():
    field = numbers(unbounded=False)
    matrices = field.matrices.copy()
    matrices[:] = 0
    table = np.zeros_like(field.table)
    faint = NgpParameters(field.shape, table, matrices, field.occupancy)
    trainable = TrainableNgp(faint, peaks(field, 100.0))
    for seed in range(5):
        trainable.accumulate(rays(400, seed=seed))
        trainable.update(NgpRates(table=0, matrices=0, peak_decay=1e-3))
    kept = trainable.rebuild_occupancy(10.0)
    assert 0 < kept < 0.6 * len(peaks(field))


@pytest.mark.parametrize("name", ["origins", "directions", "jitter", "targets"])
def test_rays_that_are_not_finite_are_refused_by_name(name):
    batch = rays()
    poisoned = getattr(batch, name).copy()
    poisoned.flat[3] = np.nan
    with pytest.raises(InvalidInput, match=rf"rays\.{name}"):
        replace(batch, **{name: poisoned})


@pytest.mark.parametrize(("rays_per_block", "samples_per_ray"), [(0, 1), (257, 1), (256, 65)])
def test_a_block_beyond_its_memory_is_refused(rays_per_block, samples_per_ray):
    with pytest.raises(InvalidInput, match=r"rays\."):
        replace(rays(), rays_per_block=rays_per_block, samples_per_ray=samples_per_ray)
