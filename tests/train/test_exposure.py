"""Per-picture exposure is found, does not move the mean, and its gradient is right."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.raster.trainable import Exposure, LearningRates, TrainableRasterizer
from rfcore.train.schedule import Bands
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.targets import ExposureModel
from rfcore.train.trainer import mean_psnr_db

CONFIG = SplatTrainingConfig(gaussians=400, iterations=600, bands=Bands(degree=0))


def test_the_gradient_of_the_map_is_that_of_finite_differences(cameras, points):
    from rfcore.train.start import gaussians_from_points

    start = gaussians_from_points(points, 300, 0.6, np.random.default_rng(0))
    # Brighter than any picture, so that L1 has no kink on the way.
    target = np.random.default_rng(1).uniform(2, 3, size=(24, 40, 3)).astype(np.float32)
    rates = LearningRates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(2)
    affine = np.eye(3, 4) + 0.1 * rng.normal(size=(3, 4))
    direction = rng.normal(size=(3, 4))

    def loss(step: float) -> tuple[float, np.ndarray]:
        exposure = Exposure((affine + step * direction).astype(np.float32), np.zeros((3, 4)))
        rasterizer = TrainableRasterizer(start)
        return rasterizer.iterate(cameras[0], target, rates, exposure=exposure), exposure.gradient

    measured = (loss(1e-2)[0] - loss(-1e-2)[0]) / 2e-2
    assert float((loss(0.0)[1] * direction).sum()) == pytest.approx(measured, rel=2e-2)


def test_no_change_costs_nothing_and_changes_nothing(cameras, points):
    from rfcore.train.start import gaussians_from_points

    start = gaussians_from_points(points, 300, 0.6, np.random.default_rng(0))
    target = np.full((24, 40, 3), 0.4, np.float32)
    plain, mapped = TrainableRasterizer(start), TrainableRasterizer(start)
    exposure = Exposure(np.eye(3, 4, dtype=np.float32), np.zeros((3, 4)))
    rates = LearningRates(1e-3)
    assert plain.iterate(cameras[0], target, rates) == mapped.iterate(
        cameras[0], target, rates, exposure=exposure
    )
    np.testing.assert_array_equal(plain.gaussians().sh, mapped.gaussians().sh)


def test_the_mean_map_stays_no_change():
    model = ExposureModel(3)
    rng = np.random.default_rng(0)
    for view in (0, 1, 2, 0, 0, 1):
        model.step(view, rng.normal(size=(3, 4)), 1.0)
    mean = np.mean([model.of_view(view).affine for view in range(3)], axis=0)
    np.testing.assert_allclose(mean, np.eye(3, 4), atol=1e-7)


def test_pictures_of_two_exposures_make_one_field_of_the_mean(posed, cameras, points):
    start = SplatTrainer(posed(lambda _: np.zeros((24, 40, 3), np.uint8)), points, CONFIG)
    truth = start.field()
    views = [200 * np.clip(truth.render_colour(camera), 0, 1) for camera in cameras]
    uneven = posed(lambda i: np.round(views[i] * (1.2 if i % 2 else 0.8)).astype(np.uint8))
    even = posed(lambda i: np.round(views[i]).astype(np.uint8))
    quality = {}
    for exposure in (False, True):
        trainer = SplatTrainer(uneven, points, replace(CONFIG, exposure=exposure))
        list(trainer.steps())
        quality[exposure] = mean_psnr_db(trainer.field(), even)
    assert quality[True] > quality[False] + 3


@pytest.mark.parametrize("shape", [(3, 3), (4, 3), (12,)])
def test_a_map_of_another_shape_is_refused(shape):
    with pytest.raises(InvalidInput, match=r"exposure\.affine"):
        Exposure(np.zeros(shape, np.float32), np.zeros((3, 4)))
