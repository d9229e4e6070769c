"""What a mask hides has no influence on a field, nor on the quality that is measured."""

from dataclasses import fields, replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.metrics import psnr, ssim
from rfcore.raster.trainable import Exposure
from rfcore.train.ngp import NgpModel, NgpTrainer, NgpTrainingConfig
from rfcore.train.poses import align_pictures
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.start import random_points
from rfcore.train.targets import Target, halved, load_targets
from rfcore.train.trainer import held_out_quality, mean_psnr_db

SHORT = SplatTrainingConfig(gaussians=200, iterations=40)
MASK = np.ones((24, 40), bool)
MASK[6:18, 12:28] = False


def street(number: int) -> np.ndarray:
    y, x = np.mgrid[:24, :40]
    return np.repeat((60 + 120 * ((x // 8 + y // 8 + number) % 2))[..., None], 3, 2).astype(
        np.uint8
    )


def passes(posed, level: int):
    """Pictures with something of ``level`` where the mask hides it."""
    pictures = posed(lambda i: np.where(MASK[..., None], street(i), np.uint8(level)))
    return [replace(picture, mask=lambda: MASK) for picture in pictures]


def arrays(trainer) -> list[bytes]:
    for _ in trainer.steps():
        pass
    if isinstance(trainer, NgpTrainer):
        return [array.tobytes() for array in trainer.checkpoint().arrays.values()]
    gaussians = trainer.gaussians()
    return [getattr(gaussians, part.name).tobytes() for part in fields(gaussians)]


@pytest.mark.parametrize(
    "config",
    [
        SHORT,
        replace(SHORT, exposure=True),
        replace(SHORT, refine_poses=True),
        replace(SHORT, halved_until=(0.5,)),
        replace(SHORT, sky=50),
    ],
)
def test_splats_do_not_depend_on_what_is_hidden(posed, points, config):
    grey, white = (SplatTrainer(passes(posed, level), points, config) for level in (90, 255))
    assert arrays(grey) == arrays(white)


def test_a_hash_grid_does_not_depend_on_what_is_hidden(posed, points):
    config = NgpTrainingConfig(
        iterations=8, batch_samples=2048, model=NgpModel(L=2, log2_T=8, occupancy=512)
    )
    grey, white = (NgpTrainer(passes(posed, level), points, config) for level in (90, 255))
    assert arrays(grey) == arrays(white)


def test_points_to_start_from_have_no_hidden_colour(posed):
    rng = np.random.default_rng
    grey, white = (random_points(passes(posed, n), 500, rng(1)) for n in (7, 255))
    assert np.array_equal(grey.rgb, white.rgb)


def test_without_the_mask_it_does_depend(posed, points):
    bare = [[replace(p, mask=None) for p in passes(posed, level)] for level in (90, 255)]
    grey, white = (SplatTrainer(pictures, points, SHORT) for pictures in bare)
    assert arrays(grey) != arrays(white)


def test_quality_is_that_of_the_pixels_that_count(posed, points):
    trainer = SplatTrainer(passes(posed, 90), points, SHORT)
    for _ in trainer.steps():
        pass
    field = trainer.field()
    grey, white = (passes(posed, level) for level in (90, 255))
    assert held_out_quality(field, grey) == held_out_quality(field, white)
    assert mean_psnr_db(field, grey) == held_out_quality(field, white).psnr_db
    bare = [replace(picture, mask=None) for picture in white]
    assert mean_psnr_db(field, bare) < mean_psnr_db(field, white)
    moved = [align_pictures(field, pictures[:1], 2.0, 1)[0].camera for pictures in (grey, white)]
    assert moved[0] == moved[1]


def test_masked_metrics_are_those_of_the_rest():
    rng = np.random.default_rng(2)
    a, b = (rng.integers(0, 256, (24, 40, 3), dtype=np.uint8) for _ in range(2))
    assert psnr(a, b, mask=MASK) == pytest.approx(psnr(a[MASK][None], b[MASK][None]))
    assert psnr(a, b, mask=np.ones_like(MASK)) == psnr(a, b)
    assert ssim(a, b, mask=np.ones_like(MASK)) == pytest.approx(ssim(a, b), abs=1e-12)
    equal_outside = np.where(MASK[..., None], b, a)
    assert ssim(a, b, mask=MASK) == ssim(a, equal_outside, mask=MASK)
    assert psnr(a, np.where(MASK[..., None], a, b), mask=MASK) == np.inf
    with pytest.raises(InvalidInput, match="leaves no pixel"):
        psnr(a, b, mask=np.zeros_like(MASK))


def test_a_pixel_of_a_halved_picture_counts_if_all_four_do(posed):
    picture = passes(posed, 9)[0]
    small = halved(Target(picture.camera, picture.read(), mask=MASK))
    assert small.mask is not None
    assert small.mask.shape == (12, 20)
    assert not small.mask[3:9, 6:14].any()
    assert small.mask.sum() == 12 * 20 - 6 * 8


def test_the_mapped_picture_is_the_kernels(posed, points, cameras):
    """Against a target that equals it, the kernel's loss is exactly 0."""
    trainer = SplatTrainer(passes(posed, 9), points, SHORT)
    rasterizer = trainer._rasterizer
    affine = np.random.default_rng(5).normal(1, 0.2, (3, 4)).astype(np.float32)
    exposure = Exposure(affine, np.zeros((3, 4)))
    target = np.zeros((24, 40, 3), np.float32)
    nothing = np.zeros((24, 40), bool)
    rates = trainer.config.rates.at(0.0, 1.0)
    assert rasterizer.iterate(cameras[0], target, rates, exposure=exposure, mask=nothing) == 0


def test_masks_that_hide_everything_are_refused(posed):
    pictures = [replace(p, mask=lambda: np.zeros((24, 40), bool)) for p in passes(posed, 9)]
    with pytest.raises(InvalidInput, match="leave no pixel to learn"):
        load_targets(pictures)
