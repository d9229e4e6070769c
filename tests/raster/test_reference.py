"""Laws of the rasterizer's definition: scenes whose picture follows by algebra, and gradients."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.reference import (
    loss_l1_dssim,
    parameters,
    render,
    spherical_harmonics,
)

AHEAD = Camera(Intrinsics(32, 24, 30.0, 28.0, 16.0, 12.0), Pose.identity())
Params = dict[str, Tensor]


def splat(
    mean: tuple[float, float, float] = (0.0, 0.0, 4.0),
    scale_m: float = 0.3,
    opacity: float = 0.6,
    rgb: tuple[float, float, float] = (0.9, 0.5, 0.1),
) -> Params:
    """One isotropic Gaussian of constant colour."""
    dc = [(value - 0.5) / SH_DC for value in rgb]
    return {
        "means": torch.tensor([mean], dtype=torch.float64),
        "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64),
        "log_scales": torch.full((1, 3), math.log(scale_m), dtype=torch.float64),
        "opacity_logits": torch.tensor([math.log(opacity / (1 - opacity))], dtype=torch.float64),
        "sh": torch.tensor([[dc]], dtype=torch.float64),
    }


def scene(*splats: Params) -> Params:
    return {name: torch.cat([one[name] for one in splats]) for name in splats[0]}


def cloud(n: int, sh_degree: int = 3, seed: int = 0) -> Params:
    """Random anisotropic Gaussians in front of ``AHEAD``."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(n, 3)) * [0.8, 0.6, 0.7] + [0, 0, 4.0],
        "quaternions": rng.normal(size=(n, 4)),
        "log_scales": rng.normal(size=(n, 3)) * 0.4 - 1.5,
        "opacity_logits": rng.normal(size=n),
        "sh": rng.normal(size=(n, (sh_degree + 1) ** 2, 3)) * 0.3,
    }
    return {name: torch.tensor(array) for name, array in arrays.items()}


def with_changed(params: Params, **changed: Tensor) -> Params:
    return {**params, **changed}


def assert_same_picture(a: Params, b: Params, camera: Camera = AHEAD) -> None:
    for got, want in zip(render(a, camera), render(b, camera), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)


def test_an_empty_field_shows_the_background_without_depth():
    empty = {name: value[:0] for name, value in splat().items()}
    colour, depth, opacity = render(empty, AHEAD, background=(0.1, 0.2, 0.3))
    assert torch.equal(colour, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand(24, 32, 3))
    assert not depth.any()
    assert not opacity.any()


def test_one_gaussian_on_the_axis_has_the_closed_form_picture():
    z, s, o, rgb = 4.0, 0.3, 0.6, (0.9, 0.5, 0.1)
    colour, depth, opacity = render(splat((0, 0, z), s, o, rgb), AHEAD)
    dx = np.arange(32) + 0.5 - 16.0
    dy = np.arange(24) + 0.5 - 12.0
    var_x, var_y = (30.0 * s / z) ** 2 + 0.3, (28.0 * s / z) ** 2 + 0.3
    alpha = o * np.exp(-0.5 * (dx[None, :] ** 2 / var_x + dy[:, None] ** 2 / var_y))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(opacity, alpha, atol=1e-15)
    np.testing.assert_allclose(colour, alpha[..., None] * rgb, atol=1e-15)
    np.testing.assert_allclose(depth, np.where(alpha > 0, z, 0.0), atol=1e-14)


def test_alpha_stops_at_099_however_opaque():
    opaque = with_changed(
        splat(scale_m=3.0), opacity_logits=torch.tensor([30.0], dtype=torch.float64)
    )
    assert render(opaque, AHEAD)[2].max() == 0.99


def test_the_nearer_of_two_gaussians_is_in_front():
    near = splat((0, 0, 3.0), 2.0, 0.7, (1, 0, 0))
    far = splat((0, 0, 6.0), 4.0, 0.5, (0, 1, 0))
    for order in (scene(near, far), scene(far, near)):
        colour, depth, opacity = render(order, AHEAD)
        pixel = colour[12, 16]
        front = pixel[0].item()
        behind = pixel[1].item()
        alpha_far = behind / (1 - front)
        assert front == pytest.approx(0.7, rel=1e-3)
        assert alpha_far == pytest.approx(0.5, rel=1e-3)
        assert opacity[12, 16].item() == pytest.approx(front + behind)
        mean_depth = (front * 3.0 + behind * 6.0) / (front + behind)
        assert depth[12, 16].item() == pytest.approx(mean_depth)


def test_coincident_gaussians_keep_their_index_order():
    red, green = splat(rgb=(1, 0, 0)), splat(rgb=(0, 1, 0))
    first_red = render(scene(red, green), AHEAD)[0][12, 16]
    first_green = render(scene(green, red), AHEAD)[0][12, 16]
    assert first_red[0] > first_red[1]
    assert torch.equal(first_red, first_green[[1, 0, 2]])


def test_a_pixel_ends_before_the_gaussian_that_would_take_the_last_ten_thousandth():
    wide = splat(scale_m=1e3, opacity=0.98)
    two, three = (render(scene(*[wide] * n), AHEAD)[2][12, 16].item() for n in (2, 3))
    assert two == pytest.approx(1 - 0.02**2, rel=1e-6)
    assert three == two, "0.02^3 = 8e-6 is under 1e-4"


@pytest.mark.parametrize("z", [0.01, 0.0, -1e-9, -5.0])
def test_nothing_at_or_behind_the_near_plane_is_drawn(z):
    assert not render(splat((0, 0, z)), AHEAD)[2].any()


def test_moving_camera_and_field_together_changes_nothing():
    move = Pose((3.0, -2.0, 5.0), (0.5, 0.5, -0.5, 0.5))
    field = cloud(12, sh_degree=0)
    turn = torch.tensor(move.rotation_matrix(), dtype=torch.float64)
    turned = with_changed(
        field,
        means=field["means"] @ turn.T + torch.tensor(move.translation_m, dtype=torch.float64),
        quaternions=hamilton_product(move.rotation, field["quaternions"]),
    )
    moved = render(turned, replace(AHEAD, world_from_cam=move))
    for got, want in zip(moved, render(field, AHEAD), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12)


def hamilton_product(a: tuple[float, float, float, float], b: Tensor) -> Tensor:
    w, x, y, z = a
    matrix = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return b @ torch.tensor(matrix, dtype=b.dtype).T


@pytest.mark.parametrize("factor", [-1.0, 1e-6, 1e6])
def test_length_and_sign_of_a_quaternion_do_not_matter(factor):
    field = cloud(8)
    assert_same_picture(with_changed(field, quaternions=field["quaternions"] * factor), field)


def test_the_zero_quaternion_is_no_rotation():
    field = cloud(8)
    zero = torch.zeros_like(field["quaternions"])
    identity = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(8, 4)
    assert_same_picture(
        with_changed(field, quaternions=zero), with_changed(field, quaternions=identity)
    )


def test_a_gaussian_no_pixel_can_see_changes_nothing():
    field = cloud(8)
    hidden = scene(field, with_changed(cloud(8), opacity_logits=torch.full((8,), -5.6)))
    assert_same_picture(hidden, field)


def test_a_window_of_the_picture_is_the_picture_of_a_window():
    """Tiles are 16 px: a window that starts at (5, 3) cuts them elsewhere."""
    field = cloud(20)
    inner = field["means"] * torch.tensor([0.3, 0.3, 1.0], dtype=torch.float64)
    field = with_changed(field, means=inner)  # clear of the Jacobian's clamp in both cameras
    k = AHEAD.intrinsics
    window = Intrinsics(20, 18, k.fx_px, k.fy_px, k.cx_px - 5, k.cy_px - 3)
    narrow = render(field, Camera(window, AHEAD.world_from_cam))
    for part, whole in zip(narrow, render(field, AHEAD), strict=True):
        torch.testing.assert_close(part, whole[3:21, 5:25], rtol=1e-12, atol=1e-12)


def test_the_antialiased_mode_keeps_the_light_of_a_gaussian_smaller_than_a_pixel():
    """Summed over the plane, opacity * 2 pi sqrt(det C) of the sharp Gaussian is what is drawn."""
    z, s, o = 4.0, 0.04, 0.6
    drawn = render(splat((0.0, 0.0, z), s, o), AHEAD, antialiased=True)[2]
    sharp_det = (30.0 * s / z) ** 2 * (28.0 * s / z) ** 2
    det = ((30.0 * s / z) ** 2 + 0.3) * ((28.0 * s / z) ** 2 + 0.3)
    dilated = render(splat((0.0, 0.0, z), s, o), AHEAD)[2]
    peak = dilated.max().item() * math.sqrt(sharp_det / det)
    assert drawn.max().item() == pytest.approx(peak, rel=1e-12)
    kept = drawn > 0
    np.testing.assert_allclose(drawn[kept], dilated[kept] * math.sqrt(sharp_det / det), rtol=1e-12)


def test_the_antialiased_mode_leaves_a_wide_gaussian_alone():
    plain, compensated = (render(splat(scale_m=20.0), AHEAD, antialiased=a) for a in (False, True))
    np.testing.assert_allclose(compensated[0], plain[0], rtol=3e-5)


def test_a_gaussian_without_area_is_not_drawn_in_the_antialiased_mode():
    thin = {"log_scales": torch.tensor([[0.0, -40.0, -40.0]], dtype=torch.float64)}
    assert not render(with_changed(splat(), **thin), AHEAD, antialiased=True)[2].any()


def test_colour_below_zero_is_cut():
    assert render(splat(rgb=(-0.5, 0.5, 0.5)), AHEAD)[0][..., 0].max() == 0


def test_the_harmonics_are_orthonormal_on_the_sphere():
    """Gauss-Legendre in z times equal steps in longitude integrates degree 6 exactly."""
    z, weight = np.polynomial.legendre.leggauss(8)
    longitude = np.arange(16) * (2 * math.pi / 16)
    radius = np.sqrt(1 - z * z)[:, None]
    directions = np.stack(
        [radius * np.cos(longitude), radius * np.sin(longitude), z[:, None] + 0 * longitude], -1
    )
    basis = spherical_harmonics(torch.tensor(directions), degree=3).reshape(-1, 16).numpy()
    area = np.repeat(weight * 2 * math.pi / 16, 16)
    np.testing.assert_allclose(basis.T @ (area[:, None] * basis), np.eye(16), atol=1e-14)


def test_the_first_harmonics_point_along_minus_y_z_and_minus_x():
    axes = spherical_harmonics(torch.eye(3, dtype=torch.float64), degree=1)[:, 1:]
    want = math.sqrt(3 / (4 * math.pi)) * np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(axes, want, atol=1e-15)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_every_parameter_agree_with_finite_differences(antialiased):
    camera = Camera(Intrinsics(7, 6, 8.0, 8.0, 3.5, 3.0), Pose((0.1, 0.2, 0.0), (1, 0, 0, 0)))
    field = {name: value.requires_grad_() for name, value in cloud(4, seed=3).items()}
    names = list(field)

    def pictures(*values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return render(dict(zip(names, values, strict=True)), camera, antialiased=antialiased)

    assert torch.autograd.gradcheck(pictures, tuple(field.values()), atol=1e-6)


POISON = {
    "needle": {"log_scales": [[math.log(1e4), math.log(1e-8), math.log(1e-8)]]},
    "disc": {"log_scales": [[math.log(1e4), math.log(1e4), math.log(1e-8)]]},
    "dust": {"log_scales": [[math.log(1e-8)] * 3]},
    "zero quaternion": {"quaternions": [[0.0, 0.0, 0.0, 0.0]]},
    "opaque": {"opacity_logits": [30.0]},
    "invisible": {"opacity_logits": [-30.0]},
    "at the camera": {"means": [[0.0, 0.0, 0.0]]},
    "on the near plane": {"means": [[0.0, 0.0, 0.01]]},
    "just beyond the near plane": {"means": [[0.3, 0.0, 0.0100001]]},
    "far off axis": {"means": [[1e4, 0.0, 0.02]]},
    "far away": {"means": [[0.0, 0.0, 1e6]]},
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("poison", POISON.values(), ids=POISON.keys())
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_poisonous_gaussian_leaves_picture_and_gradients_finite(poison, dtype, antialiased):
    bad = with_changed(splat(), **{k: torch.tensor(v).double() for k, v in poison.items()})
    field = scene(bad, splat((0.2, 0.1, 5.0)))
    field = {name: value.to(dtype).requires_grad_() for name, value in field.items()}
    colour, depth, opacity = render(field, AHEAD, antialiased=antialiased)
    (colour.sum() + depth.sum() + opacity.sum()).backward()
    for value in (colour, depth, opacity, *(p.grad for p in field.values())):
        assert value is not None
        assert torch.isfinite(value).all()
    assert opacity.max() <= 1.0


def test_parameters_carry_the_arrays_of_a_set_of_gaussians():
    arrays = {name: value.float().numpy() for name, value in cloud(3).items()}
    made = parameters(Gaussians(**arrays), torch.float32, requires_grad=True)
    for name, array in arrays.items():
        np.testing.assert_array_equal(made[name].detach(), array)
        assert made[name].requires_grad


def noise(seed: int) -> Tensor:
    return torch.rand(20, 17, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_the_loss_of_a_picture_against_itself_is_zero():
    assert loss_l1_dssim(noise(0), noise(0)).item() == pytest.approx(0, abs=1e-15)


def test_the_loss_of_constant_pictures_has_a_closed_form():
    """Under zero padding the window sees a constant a as a m and a^2 m, m its mass inside."""
    a, b = 0.7, 0.2
    taps = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    mass_x, mass_y = (np.convolve(np.ones(n), taps / taps.sum(), "same") for n in (17, 20))
    m = mass_y[:, None] * mass_x[None, :]
    spread = m - m * m
    luminance = (2 * a * b * m * m + 1e-4) / ((a * a + b * b) * m * m + 1e-4)
    ssim = luminance * (2 * a * b * spread + 9e-4) / ((a * a + b * b) * spread + 9e-4)
    flat = torch.ones(20, 17, 3, dtype=torch.float64)
    want = 0.8 * (a - b) + 0.2 * (1 - ssim.mean())
    assert loss_l1_dssim(a * flat, b * flat).item() == pytest.approx(want, rel=1e-12)


def test_the_loss_has_the_gradient_of_its_finite_differences():
    colour = noise(1)[:7, :6].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda c: loss_l1_dssim(c, noise(2)[:7, :6]), (colour,))


def test_without_dssim_the_loss_is_the_mean_absolute_difference():
    want = (noise(1) - noise(2)).abs().mean()
    assert loss_l1_dssim(noise(1), noise(2), dssim_weight=0.0) == want
