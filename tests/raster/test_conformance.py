"""One body, every implementation of the splats: held to the float64 definition on the CPU.

The torch definition in float32, the native kernels on every instruction set and on OpenCL (which
cannot train). Alphas stay below every implementation's ceiling.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from forward_isas import forward_isas
from rfcore.camera import Camera
from rfcore.native.backend import available_isas
from rfcore.raster import reference
from rfcore.raster.gaussians import SKY_M, Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import TrainableRasterizer
from rfcore.views import View
from tests.raster.conftest import camera, scene

F32 = np.float32

PICTURE_TOLERANCE, GRADIENT_TOLERANCE = 2e-5, 2e-4
"""float32 throughout: rounding of sums over some hundred splats."""
MAX_FLIPPED = 0.005
"""Share of pixels where an alpha or a transmittance falls on the other side of a threshold."""


@dataclass(frozen=True)
class Implementation:
    """Draws a set of Gaussians, and takes the gradient of a weighted sum of colours."""

    draw: Callable[[Gaussians, Camera, bool], View]
    gradients: Callable[[Gaussians, Camera, np.ndarray, bool], dict[str, np.ndarray]]


def native(isa: str) -> Implementation:
    def draw(gaussians: Gaussians, camera: Camera, antialiased: bool) -> View:
        return Rasterizer(gaussians, isa=isa, antialiased=antialiased).render(camera)

    def gradients(
        gaussians: Gaussians, camera: Camera, weights: np.ndarray, antialiased: bool
    ) -> dict[str, np.ndarray]:
        rasterizer = TrainableRasterizer(gaussians, isa=isa, antialiased=antialiased)
        rasterizer.forward(camera)
        rasterizer.backward(weights)
        return rasterizer.gradients()

    return Implementation(draw, gradients)


def torch_based(
    render: Callable[..., tuple[Tensor, Tensor, Tensor]],
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
) -> Implementation:
    def draw(gaussians: Gaussians, camera: Camera, antialiased: bool) -> View:
        params = reference.parameters(gaussians, dtype, device=device)
        pictures = render(params, camera, antialiased=antialiased)
        return View(*(picture.cpu().numpy() for picture in pictures))

    def gradients(
        gaussians: Gaussians, camera: Camera, weights: np.ndarray, antialiased: bool
    ) -> dict[str, np.ndarray]:
        params = reference.parameters(gaussians, dtype, requires_grad=True, device=device)
        colour, _, _ = render(params, camera, antialiased=antialiased)
        (colour * torch.tensor(weights, dtype=dtype, device=device)).sum().backward()
        return {name: value.grad.cpu().numpy() for name, value in params.items()}

    return Implementation(draw, gradients)


DEFINITION_FLOAT32 = "definition-float32"


@pytest.fixture(params=[DEFINITION_FLOAT32, *forward_isas()])
def implementation(request: pytest.FixtureRequest) -> Implementation:
    return _named(str(request.param))


@pytest.fixture(params=[DEFINITION_FLOAT32, *available_isas()])
def trainable(request: pytest.FixtureRequest) -> Implementation:
    return _named(str(request.param))


def _named(name: str) -> Implementation:
    return torch_based(reference.render) if name == DEFINITION_FLOAT32 else native(name)


@pytest.fixture(params=["near", "with-sky"])
def gaussians(request: pytest.FixtureRequest) -> Gaussians:
    """Opacities below 0.95: no alpha comes near a ceiling. With sky a third is 20,000 times as far
    away, and as wide."""
    made = scene(150, 2)
    times = np.ones((150, 1), F32)
    if request.param == "with-sky":
        times[::3] = 20_000
    return replace(
        made,
        means=made.means * times,
        log_scales=made.log_scales + np.log(times),
        opacity_logits=np.minimum(made.opacity_logits, F32(2.9)),
    )


DEFINITION = torch_based(reference.render, torch.float64)


def test_it_draws_the_definition(implementation, gaussians, antialiased):
    got = implementation.draw(gaussians, camera(), antialiased)
    want = DEFINITION.draw(gaussians, camera(), antialiased)
    flipped = np.abs(got.opacity - want.opacity) > PICTURE_TOLERANCE
    flipped |= (got.depth == SKY_M) != (want.depth == SKY_M)
    assert flipped.mean() <= MAX_FLIPPED
    assert np.abs(got.colour - want.colour)[~flipped].max() < PICTURE_TOLERANCE
    assert np.abs(got.depth - want.depth)[~flipped].max() < 7.0 * PICTURE_TOLERANCE


def test_its_gradients_are_those_of_the_definition(trainable, gaussians, antialiased):
    view_from = camera(61, 37)
    weights = np.random.default_rng(5).normal(size=(37, 61, 3)).astype(F32)
    got = trainable.draw(gaussians, view_from, antialiased)
    want = DEFINITION.draw(gaussians, view_from, antialiased)
    weights[np.abs(got.opacity - want.opacity) > PICTURE_TOLERANCE] = 0
    gradients = trainable.gradients(gaussians, view_from, weights, antialiased)
    for name, wanted in DEFINITION.gradients(gaussians, view_from, weights, antialiased).items():
        error = np.linalg.norm(gradients[name] - wanted) / np.linalg.norm(wanted)
        assert error < GRADIENT_TOLERANCE, name


def test_the_definition_never_leaves_the_device_of_its_parameters(gaussians, monkeypatch):
    """The meta device computes shapes alone and refuses tensors of another device, like CUDA."""

    def all_of_them(mask: Tensor) -> Tensor:
        return torch.arange(len(mask), device=mask.device)[:, None]

    monkeypatch.setattr(torch, "nonzero", all_of_them)
    params = reference.parameters(gaussians, torch.float32, device="meta")
    colour, depth, opacity = reference.render(params, camera(), antialiased=True)
    loss = reference.loss_l1_dssim(colour, colour)
    assert {value.device.type for value in (colour, depth, opacity, loss)} == {"meta"}
    assert colour.shape == (45, 67, 3)
