"""Training lowers the loss, repeats itself to the last bit, and survives poison."""

from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.raster.gaussians import Gaussians
from rfcore.train.schedule import DensityControl
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.trainer import TrainingProgress, mean_psnr_db
from rfcore.views import PointCloud
from tests.train.conftest import PAINTS

SHORT = SplatTrainingConfig(gaussians=300, iterations=60)


def checked(level: int) -> np.ndarray:
    """A picture of coarse squares."""
    y, x = np.mgrid[:24, :40]
    squares = 60 + 120 * ((x // 8 + y // 8 + level) % 2)
    return np.repeat(squares[..., None], 3, axis=2).astype(np.uint8)


def trained(pictures, points, config=SHORT, seed: int = 0) -> SplatTrainer:
    trainer = SplatTrainer(pictures, points, config, seed=seed)
    for _ in trainer.steps():
        pass
    return trainer


def trained_losses(pictures, points, config) -> list[TrainingProgress]:
    return list(SplatTrainer(pictures, points, config).steps())


def painted(posed, cameras, points):
    """Pictures of a field, so that the right answer exists."""
    start = SplatTrainer(posed(lambda _: checked(0)), points, SHORT).gaussians()
    colours = np.random.default_rng(4).normal(size=start.sh[:, :1].shape).astype(np.float32)
    truth = SplatField(replace(start, sh=np.concatenate([colours, start.sh[:, 1:]], axis=1)))
    views = [np.clip(truth.render(camera).colour, 0, 1) for camera in cameras]
    return posed(lambda i: np.round(255 * views[i]).astype(np.uint8))


def test_training_raises_the_quality_of_the_views(posed, cameras, points):
    pictures = painted(posed, cameras, points)
    config = replace(SHORT, iterations=150)
    before = SplatTrainer(pictures, points, config).field()
    after = trained(pictures, points, config).field()
    assert mean_psnr_db(after, pictures) > mean_psnr_db(before, pictures) + 6


def test_progress_counts_every_iteration_and_the_loss_falls(posed, cameras, points):
    trainer = SplatTrainer(painted(posed, cameras, points), points, SHORT)
    progress = list(trainer.steps())
    assert [p.iteration for p in progress] == list(range(1, 61))
    assert {p.total for p in progress} == {60}
    losses = [p.loss for p in progress]
    assert np.mean(losses[-8:]) < 0.7 * np.mean(losses[:8])
    assert trainer.finished
    with pytest.raises(InvalidInput, match="all 60 iterations"):
        trainer.step()


@pytest.mark.parametrize("change", [{}, {"threads": 2}, {"threads": 5}])
def test_the_same_seed_gives_the_same_bytes(posed, points, change):
    pictures = posed(checked)
    first = trained(pictures, points).field(name="a")
    again = trained(pictures, points, replace(SHORT, **change)).field(name="a")
    assert again.field_id == first.field_id


def test_gaussians_near_in_space_are_near_in_memory_from_the_start_and_after_growing(posed, points):
    def hop_m(trainer: SplatTrainer) -> float:
        return float(np.linalg.norm(np.diff(trainer.gaussians().means, axis=0), axis=1).mean())

    density = DensityControl(limit=400, interval=50, growth=0.1, start=0, stop=1)
    config = replace(SHORT, iterations=1000, density=density)
    trainer = SplatTrainer(posed(checked), points, config)
    at_start_m = hop_m(trainer)
    shuffled = np.random.default_rng(0).permutation(trainer.gaussians().means)
    assert at_start_m < 0.5 * np.linalg.norm(np.diff(shuffled, axis=0), axis=1).mean()
    for _ in range(499):
        trainer.step(0.5)
    before_m = hop_m(trainer)
    trainer.step(0.5)
    assert trainer.primitives == 400
    assert hop_m(trainer) < 0.8 * before_m


def test_the_first_share_of_a_run_looks_at_halved_pictures(posed, points):
    """Halving a picture of 1 px squares leaves one grey: only whole pictures teach the squares."""

    def fine(_: int) -> np.ndarray:
        y, x = np.mgrid[:24, :40]
        return np.repeat((255 * ((x + y) % 2))[..., None], 3, axis=2).astype(np.uint8)

    config = replace(SHORT, halved_until=(0.5,))
    losses = [progress.loss for progress in trained_losses(posed(fine), points, config)]
    assert max(losses[25:30]) < 0.25 * min(losses[30:35])


def test_another_seed_gives_another_field(posed, points):
    pictures = posed(checked)
    first, other = (trained(pictures, points, seed=seed) for seed in (0, 1))
    assert first.field().field_id != other.field().field_id
    assert first.training_digest != other.training_digest


def test_gaussians_may_be_trained_further(posed, points):
    first = trained(posed(checked), points).gaussians()
    assert len(trained(posed(checked), first).gaussians()) == len(first)


def poisonous_gaussians() -> Gaussians:
    """Needles, discs, dust, giants, zero quaternions, extreme opacities, bad places."""
    rng = np.random.default_rng(0)
    n = 256
    log_scales = rng.uniform(np.log(1e-8), np.log(1e4), (n, 3))
    means = rng.normal(size=(n, 3)) * [2, 1, 1] + [0, 0, 3]
    quaternions = rng.normal(size=(n, 4)) * 10.0 ** rng.uniform(-20, 15, (n, 1))
    logits = rng.normal(size=n) * 10
    quaternions[:16], logits[16:48], logits[48:80] = 0, 30, -30
    means[80:96], means[96:112], means[112:120] = 0, [-0.4, 0, 0], [0, 0, 0.01]
    means[120:136], means[136:152], means[152:184] = [0, 0, -2], [0, 0, 1e6], [0.1, 0.1, 2]
    means[184:192] = [1e4, 0, 0.02]
    sh = rng.normal(size=(n, 16, 3)) * 10
    values = (means, quaternions, log_scales, logits, sh)
    return Gaussians(*(np.ascontiguousarray(v, dtype=np.float32) for v in values))


def poisonous_points() -> PointCloud:
    xyz = np.zeros((64, 3), np.float32)
    xyz[:8, 2], xyz[8:16], xyz[16:24, 2], xyz[24:32] = 3, 1e6, 0.01, [-0.4, 0, 0]
    return PointCloud(xyz, np.zeros((64, 3), np.uint8))


@pytest.mark.parametrize("paint", PAINTS.values(), ids=PAINTS.keys())
@pytest.mark.parametrize("start", [poisonous_gaussians(), poisonous_points()], ids=["g", "p"])
def test_no_step_on_poison_makes_a_parameter_infinite(posed, start, paint):
    trainer = SplatTrainer(posed(paint), start, replace(SHORT, iterations=300))
    for progress in trainer.steps():
        assert np.isfinite(progress.loss)
        trainer.gaussians()  # raises on a value that is not finite
    assert trainer.finished


def test_an_empty_field_against_grey_has_the_closed_form_quality(posed):
    nothing = Gaussians(
        *(np.zeros(s, np.float32) for s in ((0, 3), (0, 4), (0, 3), (0,), (0, 16, 3)))
    )
    pictures = posed(lambda _: np.full((24, 40, 3), 51, np.uint8))
    want = -20 * np.log10(0.2)
    assert mean_psnr_db(SplatField(nothing), pictures) == pytest.approx(want)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"gaussians": 0}, "training.gaussians: 0"),
        ({"iterations": 0}, "training.iterations: 0"),
        ({"sky": -1}, "training.sky: -1"),
        ({"sky": 1_000_001}, "training.sky: 1000001"),
        ({"halved_until": (1.0,)}, r"training.halved_until: \(1.0,\)"),
        ({"halved_until": (0.2, 0.2)}, r"training.halved_until: \(0.2, 0.2\)"),
        ({"halved_until": (float("nan"),)}, r"training.halved_until: \(nan,\)"),
        ({"initial_scale": float("nan")}, "training.initial_scale: nan"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(change, named):
    with pytest.raises(InvalidInput, match=named):
        SplatTrainingConfig(**change)
