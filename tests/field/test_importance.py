"""What a splat contributes is its share of the picture; the order of importance follows it."""

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.errors import InvalidInput
from rfcore.field.importance import (
    contributions,
    most_important_first,
    reordered,
    visible_area,
)
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer

CAMERA = Camera(Intrinsics(40, 30, 30.0, 30.0, 20.0, 15.0), Pose((0, 0, -6), (1, 0, 0, 0)))


@pytest.mark.parametrize("antialiased", [False, True])
def test_all_contributions_together_are_the_opacity_of_the_picture(
    make_gaussians, antialiased: bool
) -> None:
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


def test_what_nobody_sees_contributes_next_to_nothing() -> None:
    front, hidden, behind = contributions(walls((0.0, 1.0, -9.0)), [CAMERA])
    assert front > 0.98 * 40 * 30
    assert 0 <= hidden < 0.02 * front, "an alpha is at most 0.99"
    assert behind == 0


def test_a_splat_matters_more_when_it_is_opaque_large_and_near() -> None:
    flat = np.zeros((4, 1, 3), np.float32)
    means = np.zeros((4, 3), np.float32)
    means[3] = (0, 0, 50)
    scales = np.log(np.float32([[1, 1, 1], [1, 1, 1], [0.1, 0.1, 1], [1, 1, 1]]))
    g = Gaussians(means, np.ones((4, 4), "f4"), scales, np.float32([3, -3, 3, 3]), flat)
    best, *others = visible_area(g)
    assert all(best > 5 * other for other in others)


def test_equal_splats_keep_their_order_and_none_gets_lost(make_gaussians) -> None:
    order = most_important_first(np.array([1.0, 3.0, 1.0, 3.0]))
    assert order.tolist() == [1, 3, 0, 2]
    g = make_gaussians(4)
    np.testing.assert_array_equal(reordered(g, order).sh[2], g.sh[0])
    assert len(visible_area(make_gaussians(0))) == 0


def test_contributions_to_no_camera_are_refused(make_gaussians) -> None:
    with pytest.raises(InvalidInput, match="at least one"):
        contributions(make_gaussians(), [])
