"""Training on the native kernels: gradients of the definition, deterministic steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.raster import reference
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import LearningRates, TrainableRasterizer
from tests.raster.conftest import camera, scene

F32 = NDArray[np.float32]

RATES = LearningRates(means=2e-3)
GRADIENT_TOLERANCE = 1e-4
NAMES = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def random_picture(camera: Camera, seed: int = 3) -> F32:
    k = camera.intrinsics
    rng = np.random.default_rng(seed)
    coarse = rng.random((k.height_px // 4 + 1, k.width_px // 4 + 1, 3))
    smooth = np.kron(coarse, np.ones((4, 4, 1)))[: k.height_px, : k.width_px]
    return np.ascontiguousarray(smooth, dtype=np.float32)


def relative_error(got: np.ndarray, want: np.ndarray) -> float:
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


def array_bytes(g: Gaussians) -> bytes:
    return b"".join(getattr(g, name).tobytes() for name in NAMES)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_of_a_random_cotangent_follow_the_float64_definition(degree, antialiased):
    gaussians, view_from = scene(120, degree), camera(61, 37)
    cotangent = np.random.default_rng(5).normal(size=(37, 61, 3)).astype(np.float32)
    native = TrainableRasterizer(gaussians, antialiased=antialiased)
    view = native.forward(view_from)
    params = reference.parameters(gaussians, requires_grad=True)
    colour, _, opacity = reference.render(params, view_from, antialiased=antialiased)
    flipped = np.abs(opacity.detach().numpy() - view.opacity) > 1e-5
    assert flipped.mean() <= 0.002
    cotangent[flipped] = 0
    native.backward(cotangent)
    (colour * torch.tensor(cotangent, dtype=torch.float64)).sum().backward()
    gradients = native.gradients()
    for name in NAMES:
        want = params[name].grad
        assert relative_error(gradients[name], want.numpy()) < GRADIENT_TOLERANCE, name


@pytest.mark.parametrize("size_px", [(61, 37), (16, 16), (5, 3), (1, 1), (33, 200)])
def test_loss_and_its_gradient_follow_the_float64_definition(size_px):
    gaussians, view_from = scene(60, 1), camera(*size_px)
    target = random_picture(view_from)
    native = TrainableRasterizer(gaussians, threads=2)
    colour = torch.tensor(native.forward(view_from).colour, dtype=torch.float64, requires_grad=True)
    want = reference.loss_l1_dssim(colour, torch.tensor(target, dtype=torch.float64))
    assert native.loss(target) == pytest.approx(float(want.detach()), rel=2e-6)
    (d_colour,) = torch.autograd.grad(want, colour)
    native.backward()
    through_loss = native.gradients()
    native.backward(np.ascontiguousarray(d_colour.numpy(), dtype=np.float32))
    direct = native.gradients()
    for name in ("opacity_logits", "sh", "means"):
        if np.linalg.norm(direct[name]) > 0:
            assert relative_error(through_loss[name], direct[name]) < GRADIENT_TOLERANCE, name


def test_training_steps_are_byte_equal_everywhere(isa, threads, antialiased):
    def three_steps(isa: str, threads: int) -> tuple[list[float], bytes]:
        native = TrainableRasterizer(scene(200), threads=threads, isa=isa, antialiased=antialiased)
        view_from = camera(50, 140)
        losses = [native.iterate(view_from, random_picture(view_from), RATES) for _ in range(3)]
        return losses, array_bytes(native.gaussians())

    assert three_steps(isa, threads) == three_steps("scalar", 1)


def test_the_training_forward_is_the_rendering_forward(antialiased):
    for_training = TrainableRasterizer(scene(300), antialiased=antialiased).forward(camera())
    for_rendering = Rasterizer(scene(300), antialiased=antialiased).render(camera())
    assert for_training.colour.tobytes() == for_rendering.colour.tobytes()
    assert for_training.depth.tobytes() == for_rendering.depth.tobytes()


def test_fewer_bands_render_as_if_the_others_were_zero():
    full = scene(100, 3)
    sh = full.sh.copy()
    sh[:, 4:] = 0
    cut = TrainableRasterizer(full).forward(camera(), sh_degree=1)
    zeroed = Rasterizer(replace(full, sh=sh)).render(camera())
    assert np.abs(cut.colour - zeroed.colour).max() < 1e-6


def test_one_step_is_adam_and_leaves_the_invisible_alone():
    gaussians = scene(90)
    gaussians.means[40:, 2] = -5
    native = TrainableRasterizer(gaussians)
    native.forward(camera())
    native.loss(random_picture(camera()))
    native.backward()
    gradient = native.gradients()
    native.adam_step(RATES)
    after = native.gaussians()
    for name in NAMES:
        assert getattr(after, name)[40:].tobytes() == getattr(gaussians, name)[40:].tobytes()
    # The first step of Adam moves by rate * g / (|g| + eps) = rate * sign(g).
    moved = after.means[:40] - gaussians.means[:40]
    assert moved == pytest.approx(-RATES.means * np.sign(gradient["means"][:40]), abs=1e-6)


def test_several_steps_follow_adam_in_float64():
    native = TrainableRasterizer(scene(50, 0))
    start = native.gaussians().opacity_logits.astype(np.float64)
    m, v, value = np.zeros(50), np.zeros(50), start
    for t in range(1, 6):
        native.forward(camera())
        native.loss(random_picture(camera()))
        native.backward()
        g = native.gradients()["opacity_logits"].astype(np.float64)
        native.adam_step(RATES)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        value = value - RATES.opacity * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    seen = g != 0
    assert seen.sum() > 20
    assert native.gaussians().opacity_logits[seen] == pytest.approx(value[seen], abs=1e-5)


def test_training_lowers_the_loss():
    target = Rasterizer(scene(150, seed=1)).render(camera()).colour
    native = TrainableRasterizer(scene(150, seed=2))
    losses = [native.iterate(camera(), target, RATES) for _ in range(60)]
    assert losses[-1] < 0.6 * losses[0]


def test_iterate_is_the_four_calls_at_once():
    at_once, by_hand = TrainableRasterizer(scene(100)), TrainableRasterizer(scene(100))
    target = random_picture(camera())
    for _ in range(2):
        value = at_once.iterate(camera(), target, RATES)
        by_hand.forward(camera())
        assert by_hand.loss(target) == value
        by_hand.backward()
        by_hand.adam_step(RATES)
    assert array_bytes(at_once.gaussians()) == array_bytes(by_hand.gaussians())


def test_parameters_survive_the_way_in_and_out():
    for count in (1, 16, 33):
        gaussians = scene(count, 2)
        assert array_bytes(TrainableRasterizer(gaussians).gaussians()) == array_bytes(gaussians)


def test_calls_out_of_order_are_refused():
    native = TrainableRasterizer(scene(5))
    with pytest.raises(InvalidInput, match=r"call forward\(\) first"):
        native.loss(random_picture(camera()))
    native.forward(camera())
    with pytest.raises(InvalidInput, match=r"call loss\(\) first"):
        native.backward()
    with pytest.raises(InvalidInput, match=r"call backward\(\) first"):
        native.adam_step(RATES)


def test_targets_that_do_not_fit_are_refused():
    native = TrainableRasterizer(scene(5))
    native.forward(camera())
    target = random_picture(camera())
    with pytest.raises(InvalidInput, match="float64"):
        native.loss(target.astype(np.float64))
    with pytest.raises(InvalidInput, match="contiguous"):
        native.loss(target[:, ::-1])
    target[0, 0, 0] = np.nan
    with pytest.raises(InvalidInput, match="finite"):
        native.loss(target)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"means": -1.0}, "rates.means"),
        ({"beta2": 1.0}, "rates.beta2"),
        ({"epsilon": 0.0}, "rates"),
    ],
)
def test_bad_rates_are_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        replace(RATES, **change)
