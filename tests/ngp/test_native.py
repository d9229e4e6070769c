"""The native renderer: equal to the float64 definition, and to itself wherever it runs."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rfcore.errors import BackendUnavailable, InvalidInput
from rfcore.ngp import reference
from rfcore.ngp.native import NgpRenderer
from rfcore.views import View
from tests.ngp.conftest import camera, numbers

TOLERANCE = 2e-5
"""Each of up to 60 samples is good to a few 1e-7 in exponent and colour; positions are rounded to
6e-8 of a box and the finest level has 40 cells, so features move by 1e-5 of an entry at most."""


def view_bytes(view: View) -> bytes:
    return view.colour.tobytes() + view.depth.tobytes() + view.opacity.tobytes()


def test_every_instruction_set_and_thread_count_gives_the_same_bytes(isa, threads):
    field = numbers(occupied_share=0.6)
    definition = NgpRenderer(field, isa="scalar").render(camera())
    view = NgpRenderer(field, threads=threads, isa=isa).render(camera())
    assert view_bytes(view) == view_bytes(definition)
    assert 0.1 < float(view.opacity.mean()) < 0.99


def test_pictures_drawn_at_the_same_time_are_those_drawn_one_by_one(threads):
    renderer = NgpRenderer(numbers(occupied_share=0.6), threads=threads)
    one = view_bytes(renderer.render(camera()))
    with ThreadPoolExecutor(4) as pool:
        together = {view_bytes(view) for view in pool.map(renderer.render, [camera()] * 20)}
    assert together == {one}


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize(("levels", "hidden"), [(1, 16), (5, 32), (9, 48), (16, 64)])
@pytest.mark.parametrize("samples_per_ray", [None, 5])
def test_colour_depth_and_opacity_follow_the_float64_definition(
    unbounded, levels, hidden, samples_per_ray
):
    field = numbers(unbounded=unbounded, levels=levels, hidden=hidden, occupied_share=0.7)
    view = NgpRenderer(field).render(camera(), samples_per_ray)
    colour, depth, opacity = reference.render(
        reference.parameters(field), field, camera(), samples_per_ray
    )
    error = np.abs(view.colour - colour.numpy()).max(axis=2)
    depth_error = np.abs(view.depth - depth.numpy()) * view.opacity
    opacity_error = np.abs(view.opacity - opacity.numpy())
    flipped = opacity_error > TOLERANCE
    assert flipped.mean() <= 0.02  # a sample within rounding of a cell's face, or of 1e-4
    assert error[~flipped].max() < TOLERANCE
    assert depth_error[~flipped].max() < 12 * TOLERANCE


@pytest.mark.parametrize("size_px", [(1, 1), (16, 16), (17, 3)])
def test_pictures_of_any_size_are_windows_of_the_definition(size_px):
    field, view_from = numbers(), camera(*size_px)
    want, _, _ = reference.render(reference.parameters(field), field, view_from)
    got = NgpRenderer(field, threads=2).render(view_from).colour
    assert got.shape == (size_px[1], size_px[0], 3)
    assert np.abs(got - want.numpy()).max() < TOLERANCE


def test_colour_alone_is_the_colour_of_the_view():
    renderer = NgpRenderer(numbers(occupied_share=0.5))
    view = renderer.render(camera(), 7)
    assert renderer.render_colour(camera(), 7).tobytes() == view.colour.tobytes()


def test_fewer_samples_per_ray_evaluate_fewer_and_stay_close():
    renderer = NgpRenderer(numbers(levels=2, steps_per_doubling=40))
    full = renderer.render_colour(camera())
    evaluated = [renderer.samples]
    errors = []
    for samples_per_ray in (40, 20, 10):
        errors.append(np.abs(renderer.render_colour(camera(), samples_per_ray) - full).mean())
        evaluated.append(renderer.samples)
    assert evaluated == sorted(evaluated, reverse=True)
    assert evaluated[-1] < 0.5 * evaluated[0]
    assert errors == sorted(errors)
    assert errors[0] < 0.02


def test_a_budget_no_ray_exceeds_changes_no_byte():
    renderer = NgpRenderer(numbers())
    assert view_bytes(renderer.render(camera(), 4096)) == view_bytes(renderer.render(camera()))


def test_an_instruction_set_this_machine_lacks_is_refused_by_name():
    with pytest.raises(BackendUnavailable, match=r"'vax'.*scalar"):
        NgpRenderer(numbers(), isa="vax")


@pytest.mark.parametrize("threads", [0, -1, 257])
def test_a_number_of_threads_out_of_range_is_refused(threads):
    with pytest.raises(InvalidInput, match=f"threads: {threads}"):
        NgpRenderer(numbers(), threads=threads)
