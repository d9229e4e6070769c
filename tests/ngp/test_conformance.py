"""One body, every implementation of the hash grid: held to the float64 definition on the CPU.

The torch definition in float32, the native kernels on every instruction set, and where there is a
CUDA device the definition on it.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from rfcore.camera import Camera
from rfcore.native.backend import available_isas
from rfcore.ngp import reference
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.shape import NgpParameters
from rfcore.views import View
from tests.ngp.conftest import camera, numbers

Draw = Callable[[NgpParameters, Camera], View]

TOLERANCE = 1e-4
"""Torch's float32 rounds positions along the ray, of 12 m, to 1e-6: 1e-4 of the finest cell."""
MAX_FLIPPED = 0.04
"""Share of pixels with a sample within rounding of an occupied cell's face, or of 1e-4 of light."""


def by_definition(dtype: torch.dtype, device: str = "cpu") -> Draw:
    def draw(field: NgpParameters, camera: Camera) -> View:
        params = reference.parameters(field, dtype, device=device)
        return View(*(p.cpu().numpy() for p in reference.render(params, field, camera)))

    return draw


@pytest.fixture(params=["definition-float32", *(f"native-{isa}" for isa in available_isas())])
def draw(request: pytest.FixtureRequest) -> Draw:
    name = str(request.param)
    if name.startswith("native-"):
        isa = name.removeprefix("native-")
        return lambda field, camera: NgpRenderer(field, isa=isa).render(camera)
    return by_definition(torch.float32)


@pytest.mark.parametrize("unbounded", [False, True])
def test_it_draws_the_definition(draw, unbounded):
    field = numbers(unbounded=unbounded, occupied_share=0.7)
    got = draw(field, camera())
    want = by_definition(torch.float64)(field, camera())
    flipped = np.abs(got.opacity - want.opacity) > TOLERANCE
    assert flipped.mean() <= MAX_FLIPPED
    assert np.abs(got.colour - want.colour)[~flipped].max() < 2 * TOLERANCE


def test_the_definition_never_leaves_the_device_of_its_parameters():
    """The meta device computes shapes alone and refuses tensors of another device, like CUDA."""
    field = numbers()
    params = reference.parameters(field, torch.float32, device="meta")
    rays, z_of_metre = reference.camera_rays(camera(), torch.float32, "meta")
    positions, inside = reference.contract(field.shape.space, rays.origins)
    density, colour = reference.radiance(params, field.shape.grid, positions, rays.directions)
    values = (rays.jitter, z_of_metre, inside, density, colour)
    assert {value.device.type for value in values} == {"meta"}
    assert colour.shape == (37 * 21, 3)
