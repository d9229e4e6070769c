"""The definition itself: closed forms, laws, and the paper's formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rfcore.ngp import reference
from rfcore.ngp.native import NgpRenderer
from rfcore.ngp.reference import Rays
from rfcore.ngp.shape import HashGrid, Marching, NgpParameters, NgpShape, Space, grid_levels
from tests.ngp.conftest import camera


def constant_field(log_density: float, unbounded: bool = False) -> NgpParameters:
    """A box of 2 m around the origin, of one density and colour: only two weights are not 0.

    The coarsest level's features are all 1, so W0 copies them, W1 makes the log density of them.
    """
    grid = HashGrid(grid_levels(1, 2, 2, (1.0, 1.0, 1.0)), 8)
    marching = Marching.between(0.5, 16.0, 400)
    shape = NgpShape(grid, Space((0, 0, 0), (1, 1, 1), unbounded), marching, 16, (4, 4, 4))
    w = [np.zeros(s, np.float32) for s in ((16, 16), (16, 16), (16, 32), (16, 16), (3, 16))]
    w[0][0, 0] = 1.0
    w[1][0, 0] = log_density
    w[2][0, 0] = 1.0  # the harmonic of degree 0, 0.2821
    w[3][0, 0] = 1.0
    w[4][:, 0] = (10.0, 0.0, -10.0)
    full = np.full(shape.occupancy_words, 0xFFFFFFFF, np.uint32)
    table = np.ones((32, 2), np.float32)
    return NgpParameters(shape, table, np.concatenate([m.ravel() for m in w]), full)


def ray(origin: tuple[float, float, float], direction: tuple[float, float, float]) -> Rays:
    d = torch.tensor([direction], dtype=torch.float64)
    return Rays(
        torch.tensor([origin], dtype=torch.float64), d / d.norm(), torch.full((1,), 0.5).double()
    )


def cast(field: NgpParameters, rays: Rays) -> tuple[np.ndarray, float, float]:
    colour, distance, opacity = reference.render_rays(reference.parameters(field), field, rays)
    return colour[0].numpy(), float(distance[0]), float(opacity[0])


STEP = 2 ** (1 / 400) - 1
"""A step is this share of its distance: what a face between two steps is worth."""
COLOUR = 1 / (1 + np.exp(-0.28209479177387814 * np.array([10.0, 0.0, -10.0])))


@pytest.mark.parametrize("log_density", [-3.0, 0.0, 1.0])
def test_a_slab_of_constant_density_has_the_opacity_of_algebra(log_density):
    colour, distance, opacity = cast(constant_field(log_density), ray((0, 0, -3), (0, 0, 1)))
    density = np.exp(log_density)
    want = 1 - np.exp(-2 * density)
    assert opacity == pytest.approx(want, abs=4 * STEP * density)
    assert colour == pytest.approx(want * COLOUR, abs=4 * STEP * density)
    mean = 2 + (1 / density - 2 * np.exp(-2 * density) / want)
    assert distance == pytest.approx(mean, abs=6 * STEP * 4)


def test_an_opaque_box_is_hit_on_its_face():
    colour, distance, opacity = cast(constant_field(14.0), ray((0, 0, -3), (0, 0, 1)))
    assert opacity == pytest.approx(1.0, abs=1e-4)
    assert distance == pytest.approx(2.0, abs=2 * STEP * 2)
    assert colour == pytest.approx(COLOUR, abs=1e-3)


@pytest.mark.parametrize("log_density", [15.0, 80.0, 3e38])
def test_an_overflowing_density_is_opaque_and_its_gradient_is_zero(log_density):
    field = constant_field(log_density)
    params = reference.parameters(field, requires_grad=True)
    colour, _, opacity = reference.render_rays(params, field, ray((0, 0, -3), (0, 0, 1)))
    assert float(opacity[0].detach()) == 1.0
    colour.sum().backward()
    assert torch.isfinite(params["W1"].grad).all()
    assert not params["table"].grad.isnan().any()


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((0, 0, -3), (0, 0, -1)),  # looks away
        ((0, 2, -3), (0, 0, 1)),  # passes by
        ((0, 1.001, -3), (0, 0, 1)),  # passes by, parallel to a face
        ((3, 3, 0), (1, -1, 0)),  # passes an edge
    ],
)
def test_rays_that_miss_a_bounded_field_see_black_at_depth_zero(origin, direction):
    colour, distance, opacity = cast(constant_field(2.0), ray(origin, direction))
    assert not colour.any()
    assert distance == 0.0
    assert opacity == 0.0


def test_a_ray_in_a_face_is_inside():
    _, _, opacity = cast(constant_field(1.0), ray((0, 1.0, -3), (0, 0, 1)))
    assert opacity == pytest.approx(1 - np.exp(-2 * np.e), abs=4 * STEP * np.e)


def test_what_is_left_of_an_unbounded_ray_meets_the_colour_at_infinity():
    field = constant_field(-30.0, unbounded=True)
    colour, _, opacity = cast(field, ray((0, 0, 0), (0.3, 0.2, 1)))
    assert opacity == pytest.approx(0.0, abs=1e-9)
    assert colour == pytest.approx(COLOUR, abs=1e-9)


def test_an_empty_unbounded_field_is_its_sky_and_has_no_depth():
    full = constant_field(2.0, unbounded=True)
    empty = replace(full, occupancy=np.zeros_like(full.occupancy))
    colour, distance, opacity = cast(empty, ray((0, 0, 0), (0.3, 0.2, 1)))
    assert (distance, opacity) == (0.0, 0.0)
    assert colour == pytest.approx(COLOUR, abs=1e-12)


def test_nothing_behind_an_opaque_sample_counts():
    field = constant_field(10.0)
    near = cast(field, ray((0, 0, -3), (0, 0, 1)))
    cut = replace(field.shape, marching=Marching(0.5, 2 ** (1 / 400), 850))
    assert cast(replace(field, shape=cut), ray((0, 0, -3), (0, 0, 1)))[1] == near[1]


def test_levels_grow_as_in_the_paper():
    cells = grid_levels(16, 16, 2048, (1.0, 0.5, 0.1))
    growth = np.exp((np.log(2048) - np.log(16)) / 15)
    assert [n for n, _, _ in cells] == [int(16 * growth**level + 1e-6) for level in range(16)]
    assert (cells[0], cells[-1]) == ((16, 8, 2), (2048, 1024, 205))


def test_contraction_is_the_identity_inside_and_ends_at_infinity():
    space = Space((1.0, 2.0, 3.0), (4.0, 2.0, 1.0), True)
    points = torch.tensor([[1.0, 2.0, 3.0], [5.0, 2.0, 3.0], [1e9, 2.0, 3.0]]).double()
    u, inside = reference.contract(space, points)
    assert inside.all()
    assert u[:, 0].tolist() == pytest.approx([0.5, 0.75, 1.0])
    direction = torch.tensor([[0.8, 0.0, 0.6]]).double()
    far, _ = reference.contract(space, 1e12 * direction)
    assert far[0].tolist() == pytest.approx(reference.at_infinity(space, direction)[0].tolist())


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("log_density", [-30.0, 0.0, 80.0])
def test_the_kernels_agree_on_every_closed_form(log_density, unbounded):
    field = constant_field(log_density, unbounded)
    view = NgpRenderer(field).render(camera(9, 7))
    colour, _, opacity = reference.render(reference.parameters(field), field, camera(9, 7))
    assert np.isfinite(view.colour).all()
    assert np.isfinite(view.depth).all()
    assert np.abs(view.opacity - opacity.numpy()).max() < 2e-5
    assert np.abs(view.colour - colour.numpy()).max() < 2e-5
