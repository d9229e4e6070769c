"""The Gaussians a run starts from: as wide as their neighbourhood, coloured like their points."""

import cv2
import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.train.start import LEAF_POINTS, QUERIES, gaussians_from_points, spacing_m
from rfcore.views import PointCloud


def cloud(xyz_m: np.ndarray, level: int = 200) -> PointCloud:
    return PointCloud(xyz_m.astype(np.float32), np.full((len(xyz_m), 3), level, np.uint8))


def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_spacing_of_a_grid_is_its_pitch():
    axes = [np.arange(4) * 0.25] * 3
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3).astype(np.float32)
    np.testing.assert_allclose(spacing_m(grid), 0.25, rtol=1e-6)


def test_a_search_through_all_pairs_agrees():
    xyz_m = generator().normal(size=(200, 3)).astype(np.float32)
    distances = np.linalg.norm(xyz_m[:, None].astype(float) - xyz_m[None], axis=-1)
    want = np.sort(distances, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(spacing_m(xyz_m), want, rtol=1e-5)


def points_of_many_kinds() -> dict[str, np.ndarray]:
    """Clouds around which a search tree goes wrong: long tails, copies, outliers, few points."""
    rng = generator()
    return {
        "two": rng.normal(size=(2, 3)),
        "as many as a leaf": rng.normal(size=(LEAF_POINTS, 3)),
        "one more than a leaf": rng.normal(size=(LEAF_POINTS + 1, 3)),
        "one more than a batch": rng.normal(size=(QUERIES + 1, 3)),
        "long tails": np.exp(3 * rng.normal(size=(3000, 3))),
        "outliers": np.vstack([rng.normal(size=(2000, 3)), 1e6 * rng.normal(size=(50, 3))]),
        "copies": np.repeat(rng.normal(size=(100, 3)), 30, axis=0),
        "a plane": rng.normal(size=(2000, 3)) * [1, 1, 0],
        "one place": np.zeros((500, 3)),
    }


@pytest.mark.parametrize("kind", points_of_many_kinds())
def test_spacing_is_that_of_opencvs_exact_tree_to_the_bit(kind):
    xyz_m = points_of_many_kinds()[kind].astype(np.float32)
    exact_tree = cv2.flann.Index(xyz_m, {"algorithm": 4})
    _, squared = exact_tree.knnSearch(xyz_m, min(4, len(xyz_m)), params={})
    want = np.sqrt(squared.astype(np.float64))[:, 1:].mean(axis=1)
    np.testing.assert_array_equal(spacing_m(xyz_m), want)


def test_deviation_is_spacing_times_scale():
    line = np.arange(12)[:, None] * np.array([[0.5, 0, 0]])
    made = gaussians_from_points(cloud(line), 12, 0.6, generator())
    np.testing.assert_allclose(np.exp(made.log_scales[5]), 0.6 * (0.5 + 0.5 + 1.0) / 3, rtol=1e-5)


def test_coincident_and_stray_points_get_a_finite_width():
    made = gaussians_from_points(cloud(np.zeros((9, 3))), 9, 1.0, generator())
    np.testing.assert_allclose(np.exp(made.log_scales), 1e-3, rtol=1e-5)
    stray = np.vstack([generator().normal(size=(9, 3)), [[1e6, 0, 0]]])
    made = gaussians_from_points(cloud(stray), 10, 1.0, generator())
    assert np.exp(made.log_scales).max() == pytest.approx(20.0)


def test_a_gaussian_has_its_points_colour_from_every_side():
    made = gaussians_from_points(cloud(generator().normal(size=(8, 3)), 51), 8, 1.0, generator())
    np.testing.assert_allclose(0.28209479 * made.sh[:, 0] + 0.5, 0.2, rtol=1e-6)
    assert not made.sh[:, 1:].any()


def test_a_subset_is_drawn_without_repetition_and_by_seed():
    points = cloud(generator().normal(size=(50, 3)))
    first, again = (gaussians_from_points(points, 20, 1.0, generator()).means for _ in range(2))
    other = gaussians_from_points(points, 20, 1.0, np.random.default_rng(1)).means
    assert len(np.unique(first, axis=0)) == 20
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert len(gaussians_from_points(points, 999, 1.0, generator())) == 50


def test_too_few_points_are_refused():
    with pytest.raises(InvalidInput, match="3 are too few, 4 or more"):
        gaussians_from_points(cloud(np.zeros((3, 3))), 3, 1.0, generator())
