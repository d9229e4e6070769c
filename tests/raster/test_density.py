"""Density control: the dead end, splits look like the original, the same seed does the same."""

from dataclasses import fields

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.native.backend import available_isas
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.trainable import DensityStep, LearningRates, TrainableRasterizer

CAMERA = Camera(Intrinsics(48, 32, 40.0, 40.0, 24.0, 16.0), Pose((0, 0, 0), (1.0, 0, 0, 0)))
RATES = LearningRates(means=1e-3)


def one(logit: float, log_scales=(-1.5, -2.5, -3.0), quaternion=(0.9, 0.1, -0.3, 0.2)) -> Gaussians:
    values = ([[0.0, 0.0, 3.0]], [quaternion], [log_scales], [logit], np.zeros((1, 16, 3)))
    return Gaussians(*(np.asarray(v, np.float32) for v in values))


def many(n: int = 200) -> Gaussians:
    rng = np.random.default_rng(5)
    values = (
        rng.normal(size=(n, 3)) * 0.6 + [0, 0, 3],
        rng.normal(size=(n, 4)),
        rng.normal(size=(n, 3)) * 0.4 - 2.5,
        rng.normal(size=n) * 5,
        rng.normal(size=(n, 16, 3)),
    )
    return Gaussians(*(np.ascontiguousarray(v, dtype=np.float32) for v in values))


def grey() -> np.ndarray:
    return np.full((32, 48, 3), 0.5, np.float32)


def values_of(gaussians: Gaussians) -> bytes:
    return b"".join(getattr(gaussians, f.name).tobytes() for f in fields(gaussians))


def is_dead(gaussians: Gaussians) -> np.ndarray:
    return gaussians.opacity_logits <= np.float32(-5.293305)


def test_every_dead_gaussian_is_replaced_and_the_added_join_at_the_end():
    start = many()
    rasterizer = TrainableRasterizer(start)
    replaced = rasterizer.control_density(DensityStep(added=37, seed=1))
    assert replaced == int(is_dead(start).sum()) > 0
    after = rasterizer.gaussians()
    assert len(after) == len(rasterizer) == 237
    assert not is_dead(after).any()


def test_gaussians_nobody_drew_are_untouched():
    start = many()
    rasterizer = TrainableRasterizer(start)
    rasterizer.control_density(DensityStep(added=1, seed=1))
    same = (rasterizer.gaussians().means[:200] == start.means).all(axis=1)
    assert same.sum() >= 200 - is_dead(start).sum() - 1


@pytest.mark.parametrize("copies", [1, 2, 7, 40])
def test_parts_in_place_add_up_to_the_original_opacity(copies):
    # 1 - (1 - part)^(copies + 1) = o (Kheradmand et al. 2024, eq. 9)
    rasterizer = TrainableRasterizer(one(2.0))
    rasterizer.control_density(DensityStep(added=copies, seed=1))
    parts = 1 / (1 + np.exp(-rasterizer.gaussians().opacity_logits.astype(float)))
    assert 1 - np.prod(1 - parts) == pytest.approx(1 / (1 + np.exp(-2.0)), rel=1e-5)


@pytest.mark.parametrize("logit", [-2.0, 0.0, 2.0])
def test_parts_in_place_are_as_wide_as_the_paper_says(logit):
    from math import comb, sqrt

    rasterizer = TrainableRasterizer(one(logit))
    rasterizer.control_density(DensityStep(added=3, seed=1))
    o = 1 / (1 + np.exp(-logit))
    part = 1 - (1 - o) ** 0.25
    total = sum(
        comb(i, k) * (-1) ** k * part ** (k + 1) / sqrt(k + 1)
        for i in range(4)
        for k in range(i + 1)
    )
    want = np.array([-1.5, -2.5, -3.0]) + np.log(o / total)
    np.testing.assert_allclose(rasterizer.gaussians().log_scales, np.tile(want, (4, 1)), rtol=1e-5)


@pytest.mark.parametrize("in_place", [True, False])
def test_splitting_hardly_changes_the_picture(in_place):
    rasterizer = TrainableRasterizer(one(1.0))
    before = rasterizer.forward(CAMERA).opacity
    rasterizer.control_density(DensityStep(added=1, seed=1, in_place=in_place))
    after = rasterizer.forward(CAMERA).opacity
    # In place keeps the integral but not the shape; halves keep neither exactly.
    assert before.max() > 0.5
    assert np.abs(after - before).max() < (0.05 if in_place else 0.12)
    assert after.sum() == pytest.approx(before.sum(), rel=0.02 if in_place else 0.12)


def test_halves_lie_side_by_side_along_the_longest_axis():
    rasterizer = TrainableRasterizer(one(0.0, (-3.0, -1.0, -2.0), (1.0, 0.0, 0.0, 0.0)))
    rasterizer.control_density(DensityStep(added=1, seed=1, in_place=False))
    halves = rasterizer.gaussians()
    offset = 0.7 * np.exp(-1.0)
    np.testing.assert_allclose(
        halves.means, [[0, offset, 3], [0, -offset, 3]], rtol=1e-5, atol=1e-7
    )
    np.testing.assert_allclose(halves.log_scales[:, 1], -1.0 + np.log(0.6), rtol=1e-5)
    np.testing.assert_allclose(halves.log_scales[:, [0, 2]], [[-3, -2]] * 2)


def test_drawing_by_gradient_splits_the_one_the_pictures_pull_at():
    start = many(64)
    start.means[:] += [0, 0, -20]  # behind the camera: no gradient
    start.means[9] = [0.1, 0, 3]
    start.opacity_logits[:] = 1.0
    rasterizer = TrainableRasterizer(start)
    rasterizer.keep_scores(True)
    rasterizer.iterate(CAMERA, grey(), RATES)
    assert rasterizer.state().scores[:, 1].nonzero()[0].tolist() == [9]
    moved = rasterizer.gaussians().means[9]
    rasterizer.control_density(DensityStep(added=3, seed=1, by_gradient=True))
    np.testing.assert_array_equal(rasterizer.gaussians().means[-3:], np.tile(moved, (3, 1)))
    assert not rasterizer.state().scores.any()


def test_nothing_happens_when_none_is_alive():
    rasterizer = TrainableRasterizer(one(-9.0))
    assert rasterizer.control_density(DensityStep(added=5, seed=1)) == 0
    assert len(rasterizer) == 1


def test_noise_moves_the_faint_and_leaves_the_opaque():
    start = many()
    rasterizer = TrainableRasterizer(start)
    rasterizer.perturb(1.0, seed=3)
    moved = (rasterizer.gaussians().means != start.means).any(axis=1)
    assert moved[start.opacity_logits < -3].all()
    assert not moved[start.opacity_logits > -2].any()


def test_noise_is_about_normal_in_the_gaussians_own_axes():
    n = 4000
    values = (np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), np.tile([0.0, -1, -2], (n, 1)))
    sh = np.zeros((n, 1, 3))
    start = Gaussians(*(np.asarray(v, np.float32) for v in (*values, np.full(n, -30.0), sh)))
    rasterizer = TrainableRasterizer(start)
    rasterizer.perturb(1.0, seed=3)
    # The gate at opacity 0 is 1 / (1 + e^-0.5); a deviation is known to 1/sqrt(2 n) of itself.
    gate = 1 / (1 + np.exp(-0.5))
    deviations = rasterizer.gaussians().means.std(axis=0) / np.exp([0.0, -1, -2])
    np.testing.assert_allclose(deviations, gate, rtol=4 / np.sqrt(2 * n))


def test_removing_the_dead_keeps_the_others_in_order_with_their_moments():
    start = many()
    rasterizer = TrainableRasterizer(start)
    rasterizer.iterate(CAMERA, grey(), RATES)
    before = rasterizer.state()
    alive = ~is_dead(before.gaussians)
    rasterizer.remove_dead()
    after = rasterizer.state()
    np.testing.assert_array_equal(after.gaussians.sh, before.gaussians.sh[alive])
    np.testing.assert_array_equal(after.second_moments.sh, before.second_moments.sh[alive])
    rasterizer.iterate(CAMERA, grey(), RATES)


def curve_order(means: np.ndarray) -> np.ndarray:
    """Return the stable order along a Morton curve of 21 bits an axis, x in the lowest bit."""
    x = means.astype(np.float64) - means.min(axis=0).astype(np.float64)
    cells = (x / x.max() * (2**21 - 1)).astype(int)
    codes = [
        sum((cell[axis] >> bit & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3))
        for cell in cells.tolist()
    ]
    return np.argsort(np.array(codes, np.uint64), kind="stable")


def test_sorting_along_the_curve_takes_moments_and_scores_along():
    rasterizer = TrainableRasterizer(many())
    rasterizer.keep_scores(True)
    rasterizer.iterate(CAMERA, grey(), RATES)
    before = rasterizer.state()
    rasterizer.order_along_curve()
    after, order = rasterizer.state(), curve_order(before.gaussians.means)
    assert (order != np.arange(200)).any()
    for part in ("gaussians", "first_moments", "second_moments"):
        for f in fields(Gaussians):
            rows = [getattr(getattr(state, part), f.name) for state in (before, after)]
            np.testing.assert_array_equal(rows[1], rows[0][order])
    assert before.scores.any()
    np.testing.assert_array_equal(after.scores, before.scores[order])


def test_gaussians_in_one_place_keep_their_order_on_the_curve():
    start = many(40)
    start.means[:] = [0.0, 0.0, 3.0]
    rasterizer = TrainableRasterizer(start)
    rasterizer.order_along_curve()
    assert values_of(rasterizer.gaussians()) == values_of(start)


def test_no_gaussians_at_all_can_be_sorted():
    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 16, 3))
    rasterizer = TrainableRasterizer(Gaussians(*(np.zeros(s, np.float32) for s in shapes)))
    rasterizer.order_along_curve()
    assert len(rasterizer) == 0


def trained_bytes(isa: str, threads: int, by_gradient: bool, in_place: bool) -> bytes:
    rasterizer = TrainableRasterizer(many(), isa=isa, threads=threads)
    rasterizer.keep_scores(by_gradient)
    for seed in range(4):
        rasterizer.iterate(CAMERA, grey(), LearningRates(1e-3, opacity_pull=1e-4, scale_pull=1e-4))
        rasterizer.perturb(0.5, seed)
        step = DensityStep(added=21, seed=seed, by_gradient=by_gradient, in_place=in_place)
        rasterizer.control_density(step)
        rasterizer.order_along_curve()
    return values_of(rasterizer.gaussians())


@pytest.mark.parametrize("by_gradient", [False, True])
@pytest.mark.parametrize("in_place", [False, True])
def test_every_instruction_set_and_thread_count_gives_the_same_bytes(by_gradient, in_place):
    made = {
        trained_bytes(isa, threads, by_gradient, in_place)
        for isa in available_isas()
        for threads in (1, 2)
    }
    assert len(made) == 1


@pytest.mark.parametrize("pull", ["opacity_pull", "scale_pull"])
def test_a_pull_lowers_what_it_pulls_at(pull):
    def after(rates: LearningRates) -> Gaussians:
        rasterizer = TrainableRasterizer(one(1.0))
        rasterizer.forward(CAMERA)
        rasterizer.backward(np.zeros((32, 48, 3), np.float32))
        rasterizer.adam_step(rates)
        return rasterizer.gaussians()

    free, pulled = after(LearningRates(0.0)), after(LearningRates(0.0, **{pull: 1e-3}))
    # Adam's first step is its rate, whatever the gradient.
    fall = 0.05 if pull == "opacity_pull" else 0.0
    np.testing.assert_allclose(pulled.opacity_logits - free.opacity_logits, -fall, atol=1e-6)
    fall = 5e-3 if pull == "scale_pull" else 0.0
    np.testing.assert_allclose(pulled.log_scales - free.log_scales, -fall, atol=1e-6)


@pytest.mark.parametrize("change", [{"added": -1}, {"seed": -1}, {"seed": 1 << 64}])
def test_steps_that_make_no_sense_are_refused(change):
    with pytest.raises(InvalidInput, match="density"):
        DensityStep(**{"added": 1, "seed": 1, **change})
