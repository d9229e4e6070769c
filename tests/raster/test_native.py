"""The native renderer: equal to the float64 definition, and to itself wherever it runs."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.raster import reference
from rfcore.raster.gaussians import SKY_M, Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.views import View
from tests.raster.conftest import camera, scene

FORWARD_TOLERANCE = 1e-5
"""exp2 is good to 2.6e-6; weights sum to at most 1, colours here stay below 3."""


def view_bytes(view: View) -> bytes:
    return view.colour.tobytes() + view.depth.tobytes() + view.opacity.tobytes()


def on_axis(opacity_logit: float = 0.0, depth_m: float = 4.0, scale_m: float = 0.2) -> Gaussians:
    f32 = np.float32
    return Gaussians(
        np.array([[0, 0, depth_m]], f32),
        np.array([[1, 0, 0, 0]], f32),
        np.full((1, 3), np.log(scale_m), f32),
        np.array([opacity_logit], f32),
        np.full((1, 1, 3), 1.0, f32),
    )


def forward_camera(width_px: int = 33, height_px: int = 17) -> Camera:
    half = (0.5 * width_px, 0.5 * height_px)
    return Camera(Intrinsics(width_px, height_px, 40.0, 40.0, *half), Pose.identity())


def test_every_instruction_set_and_thread_count_gives_the_same_bytes(
    forward_isa, threads, antialiased
):
    definition = Rasterizer(scene(700), isa="scalar", antialiased=antialiased).render(camera())
    rasterizer = Rasterizer(scene(700), threads=threads, isa=forward_isa, antialiased=antialiased)
    view = rasterizer.render(camera())
    assert rasterizer.isa == forward_isa
    assert view_bytes(view) == view_bytes(definition)
    assert 0.2 < float(view.opacity.mean()) < 0.95


def test_pictures_drawn_at_the_same_time_are_those_drawn_one_by_one(threads):
    rasterizer = Rasterizer(scene(700), threads=threads)
    cameras = [camera(*size_px) for size_px in ((67, 45), (200, 120), (16, 16), (131, 99))]
    one_by_one = [view_bytes(rasterizer.render(each)) for each in cameras]
    with ThreadPoolExecutor(len(cameras)) as pool:
        together = [view_bytes(view) for view in pool.map(rasterizer.render, cameras * 10)]
    assert together == one_by_one * 10


def test_fields_of_any_size_are_drawn_in_the_same_memory(threads):
    counts, small, large = (700, 40, 2000), camera(16, 16), camera(200, 120)
    alone = []
    for count in counts:  # with nothing left behind: it goes with the last that uses it
        rasterizer = Rasterizer(scene(count), threads=threads)
        alone += [view_bytes(rasterizer.render(each)) for each in (small, large)]
        del rasterizer
    every = [Rasterizer(scene(count), threads=threads) for count in counts]
    work = [(each, view_from) for each in every for view_from in (small, large)] * 10
    in_turn = [view_bytes(each.render(view_from)) for each, view_from in work]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda x: view_bytes(x[0].render(x[1])), work))
    assert in_turn == together == alone * 10


def test_another_thread_count_of_the_same_gaussians_outlives_the_first(threads, antialiased):
    first = Rasterizer(scene(700), threads=3, antialiased=antialiased)
    definition = view_bytes(first.render(camera()))
    own = first.with_threads(threads)
    del first
    assert (own.threads, own.antialiased) == (threads, antialiased)
    assert view_bytes(own.render(camera())) == definition
    with pytest.raises(InvalidInput, match="threads"):
        own.with_threads(0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("size_px", [(67, 45), (16, 16), (1, 1), (3, 50)])
def test_colour_depth_and_opacity_follow_the_float64_definition(degree, size_px, antialiased):
    gaussians, view_from = scene(200, degree), camera(*size_px)
    view = Rasterizer(gaussians, antialiased=antialiased).render(view_from)
    colour, depth, opacity = reference.render(
        reference.parameters(gaussians), view_from, antialiased=antialiased
    )
    error = np.abs(view.colour - colour.numpy()).max(axis=2)
    assert_close_but_for_flips(error, view.depth - depth.numpy(), view.opacity - opacity.numpy())


def assert_close_but_for_flips(
    colour_error: np.ndarray, depth_error: np.ndarray, opacity_error: np.ndarray
) -> None:
    """A pixel whose alpha or transmittance rounds across a threshold may differ by one weight."""
    flipped = np.abs(opacity_error) > FORWARD_TOLERANCE
    assert flipped.mean() <= 0.002
    assert colour_error[~flipped].max(initial=0) < FORWARD_TOLERANCE
    assert np.abs(depth_error[~flipped]).max(initial=0) < 7.0 * FORWARD_TOLERANCE


def test_one_gaussian_on_the_axis_has_the_value_of_algebra():
    view = Rasterizer(on_axis()).render(forward_camera())
    variance_px2 = (40.0 * 0.2 / 4.0) ** 2 + 0.3
    colour = 0.5 + 0.28209479177387814
    for dx, dy in [(0, 0), (1, 0), (0, -2), (-3, 2)]:
        alpha = 0.5 * np.exp(-0.5 * (dx * dx + dy * dy) / variance_px2)
        pixel = (8 + dy, 16 + dx)
        assert view.opacity[pixel] == pytest.approx(alpha, abs=3e-6)
        assert view.colour[pixel] == pytest.approx(np.full(3, alpha * colour), abs=3e-6)
        assert view.depth[pixel] == pytest.approx(4.0, rel=1e-6)


def test_the_sky_leaves_the_depth_of_a_surface_as_it_is_until_it_is_more_of_the_pixel():
    """Surfaces that let 40 and 60 % of an opaque sky through."""
    sky = on_axis(opacity_logit=20.0, depth_m=1e5, scale_m=1e5)
    for share, depth_m, opacity in ((0.4, SKY_M, 0.99 * 0.6), (0.6, 4.0, 0.6)):
        surface = on_axis(float(np.log(share / (1 - share))), scale_m=50.0)
        view = Rasterizer(_joined(surface, sky)).render(forward_camera())
        alone = Rasterizer(surface).render(forward_camera())
        np.testing.assert_allclose(view.depth, depth_m, rtol=1e-6)
        assert view.opacity[8, 16] == pytest.approx(opacity, abs=0.005)
        assert view.colour[8, 16] == pytest.approx(alone.colour[8, 16] / share * 0.99, rel=0.02)


def test_a_sky_without_anything_before_it_is_at_the_depth_of_the_sky():
    view = Rasterizer(on_axis(depth_m=1.01 * SKY_M, scale_m=1e5)).render(forward_camera())
    assert (view.depth == SKY_M).all()
    np.testing.assert_allclose(view.opacity, 0.5, rtol=0.02)
    assert view.colour.min() > 0.3


def test_splats_behind_an_opaque_wall_change_nothing():
    wall = on_axis(opacity_logit=20.0, depth_m=0.5, scale_m=50.0)
    walls = _joined(*[wall] * 6, degree=3)
    behind = _joined(*[wall] * 6, scene(300), degree=3)
    alone = Rasterizer(walls).render(forward_camera())
    assert view_bytes(Rasterizer(behind).render(forward_camera())) == view_bytes(alone)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_fewer_bands_are_the_picture_of_a_field_that_has_no_more(forward_isa, degree):
    full = scene(300, 3)
    cut = replace(full, sh=np.ascontiguousarray(full.sh[:, : (degree + 1) ** 2]))
    want = Rasterizer(cut, isa=forward_isa).render(camera())
    rasterizer = Rasterizer(full, isa=forward_isa)
    got = rasterizer.render(camera(), sh_degree=degree)
    assert view_bytes(got) == view_bytes(want)
    alone = rasterizer.render_colour(camera(), sh_degree=degree)
    assert alone.tobytes() == want.colour.tobytes()
    assert view_bytes(rasterizer.render(camera())) != view_bytes(want)


@pytest.mark.parametrize("degree", [-1, 2, 7])
def test_bands_a_field_lacks_are_refused(degree):
    with pytest.raises(InvalidInput, match=f"sh_degree: {degree} is outside 0..1"):
        Rasterizer(scene(3, 1)).render(camera(), sh_degree=degree)


def test_statistics_count_every_weight_of_a_picture():
    statistics = Rasterizer(on_axis()).statistics(forward_camera())
    opacity = Rasterizer(on_axis()).render(forward_camera()).opacity
    assert statistics.visible == 1
    assert statistics.useful_blends == np.count_nonzero(opacity)
    assert statistics.blends_per_px == pytest.approx(np.mean(opacity > 0))


def test_an_instruction_set_this_machine_lacks_is_refused_by_name():
    with pytest.raises(BackendUnavailable, match=r"'vax'.*scalar"):
        Rasterizer(on_axis(), isa="vax")


@pytest.mark.parametrize("threads", [0, -1, 257])
def test_a_number_of_threads_out_of_range_is_refused(threads):
    with pytest.raises(InvalidInput, match=f"threads: {threads}"):
        Rasterizer(on_axis(), threads=threads)


def _arrays(g: Gaussians) -> tuple[np.ndarray, ...]:
    return (g.means, g.quaternions, g.log_scales, g.opacity_logits, g.sh)


def _joined(*parts: Gaussians, degree: int = 0) -> Gaussians:
    coefficients = (degree + 1) ** 2
    padded = [
        (*_arrays(p)[:4], np.pad(p.sh, ((0, 0), (0, coefficients - p.sh.shape[1]), (0, 0))))
        for p in parts
    ]
    return Gaussians(*(np.concatenate(column) for column in zip(*padded, strict=True)))


def test_torch_runs_beside_the_threads_of_the_rasterizer():
    rasterizer = Rasterizer(scene(50), threads=2)
    before = view_bytes(rasterizer.render(camera()))
    torch.set_flush_denormal(True)
    try:
        assert view_bytes(rasterizer.render(camera())) == before
    finally:
        torch.set_flush_denormal(False)
