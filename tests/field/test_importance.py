"""A splat contributes its share of the picture; the order of importance follows it."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field.importance import (
    contributions,
    frugal_colours,
    most_important_first,
    reordered,
    seen_directions,
    visible_area,
)
from rfcore.field.splat_grid import Steps, colour_numbers, colours_of
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from tests.field.some import make_gaussians

CAMERA = Camera(Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0), Pose((0, 0, -6), (1, 0, 0, 0)))


@pytest.mark.parametrize("antialiased", [False, True])
def test_all_contributions_together_are_the_opacity_of_the_picture(antialiased):
    """Tolerance: float32 sums of 1200 pixels, each rounded at 2^-24 of at most 1."""
    g = make_gaussians(60)
    opacity = Rasterizer(g, antialiased=antialiased).render(CAMERA).opacity.sum(dtype=np.float64)
    total = contributions(g, [CAMERA, CAMERA], antialiased=antialiased).sum()
    assert opacity > 10
    assert total == pytest.approx(2 * opacity, rel=1200 * 2**-24)


def walls(depths_m: tuple[float, ...]) -> Gaussians:
    """Opaque discs that fill the picture, one behind the other."""
    n = len(depths_m)
    means = np.array([(0, 0, z) for z in depths_m], np.float32)
    flat = np.tile(np.log(np.float32([20, 20, 0.01])), (n, 1))
    turned = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(means, turned, flat, np.full(n, 9, np.float32), np.zeros((n, 1, 3), "f4"))


def test_what_nobody_sees_contributes_next_to_nothing():
    front, hidden, behind = contributions(walls((0.0, 1.0, -9.0)), [CAMERA])
    assert front > 0.98 * 40 * 30
    assert 0 <= hidden < 0.02 * front, "an alpha is at most 0.99"
    assert behind == 0


def test_a_splat_matters_more_when_it_is_opaque_large_and_near():
    flat = np.zeros((4, 1, 3), np.float32)
    means = np.zeros((4, 3), np.float32)
    means[3] = (0, 0, 50)
    scales = np.log(np.float32([[1, 1, 1], [1, 1, 1], [0.1, 0.1, 1], [1, 1, 1]]))
    g = Gaussians(means, np.ones((4, 4), "f4"), scales, np.float32([3, -3, 3, 3]), flat)
    best, *others = visible_area(g)
    assert all(best > 5 * other for other in others)


def test_equal_splats_keep_their_order_and_none_gets_lost():
    order = most_important_first(np.array([1.0, 3.0, 1.0, 3.0]))
    assert order.tolist() == [1, 3, 0, 2]
    g = make_gaussians(4)
    np.testing.assert_array_equal(reordered(g, order).sh[2], g.sh[0])
    assert len(visible_area(make_gaussians(0))) == 0


def test_contributions_to_no_camera_are_refused():
    with pytest.raises(InvalidInput, match="at least one"):
        contributions(make_gaussians(), [])


STEPS = Steps()


def seen_error(error: np.ndarray, seen: np.ndarray) -> float:
    """Return the visible error of colour errors [N, K, 3], by the definition."""
    return float(np.einsum("nkc,nkl,nlc->", error, seen, error))


def test_directions_seen_are_those_of_the_cameras():
    """The constant coefficient is seen as often as the splat contributes, from anywhere."""
    g = make_gaussians(20, 2)
    seen = seen_directions(g, [CAMERA, CAMERA])
    weights = contributions(g, [CAMERA, CAMERA])
    assert seen.shape == (20, 9, 9)
    np.testing.assert_allclose(seen[:, 0, 0], weights * 0.28209479**2, rtol=1e-5)
    np.testing.assert_allclose(seen, seen.transpose(0, 2, 1), rtol=1e-6)
    ranks = np.linalg.matrix_rank(seen[weights > 0], tol=1e-3 * float(seen.max()))
    assert ranks.max() == 1, "one place is one direction for each splat"


def test_without_a_price_colours_are_no_worse_than_the_nearest_ones():
    g = make_gaussians(40, 3)
    seen = seen_directions(g, [CAMERA])
    nearest = colours_of(colour_numbers(g.sh, STEPS), STEPS)
    free = frugal_colours(g, seen, STEPS, 0.0)
    assert seen_error(free.sh - g.sh, seen) <= seen_error(nearest - g.sh, seen)
    assert np.array_equal(colours_of(colour_numbers(free.sh, STEPS), STEPS), free.sh), "on the grid"


def test_a_price_trades_what_is_seen_for_zeros():
    g = make_gaussians(200, 3)
    seen = seen_directions(g, [CAMERA])
    errors, zeros = [], []
    for price in (0.001, 0.1, 10.0):
        found = frugal_colours(g, seen, STEPS, price)
        errors.append(seen_error(found.sh - g.sh, seen))
        zeros.append(int((colour_numbers(found.sh, STEPS) == 0).sum()))
    assert errors == sorted(errors)
    assert zeros == sorted(set(zeros))


def test_colours_that_nobody_sees_cost_nothing_and_seen_ones_stay():
    g = make_gaussians(30, 3)
    hidden = reordered(g, np.arange(30))
    hidden.means[:, 2] = -9
    found = frugal_colours(hidden, seen_directions(hidden, [CAMERA]), STEPS, 0.001)
    assert not colour_numbers(found.sh[:, 1:], STEPS)[:, 1:15].any()
    seen = seen_directions(g, [CAMERA])
    dear = frugal_colours(g, seen, STEPS, 1e-6)
    before, after = Rasterizer(g).render(CAMERA).colour, Rasterizer(dear).render(CAMERA).colour
    assert np.abs(after - before).max() < 0.05


def test_matrices_of_other_splats_and_negative_prices_are_refused():
    g = make_gaussians(4, 1)
    seen = seen_directions(g, [CAMERA])
    with pytest.raises(InvalidInput, match=r"seen: \(3, 4, 4\) is not \(4, 4, 4\)"):
        frugal_colours(g, seen[:3], STEPS, 0.1)
    with pytest.raises(InvalidInput, match=r"price: -1\.0 is below 0"):
        frugal_colours(g, seen, STEPS, -1.0)
