"""Training a hash grid lowers the loss, repeats itself to the last bit, and survives poison."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rfcore.errors import InvalidInput, TrainingDiverged
from rfcore.train.ngp import NgpModel, NgpSchedule, NgpTrainer, NgpTrainingConfig
from rfcore.train.trainer import mean_psnr_db, read_checkpoint, write_checkpoint
from rfcore.views import PointCloud
from tests.train.conftest import PAINTS

SMALL = NgpModel(
    L=6, log2_T=11, N_min=4, N_max=96, hidden=16, occupancy=20_000, steps_per_doubling=12
)
SHORT = NgpTrainingConfig(iterations=40, batch_samples=2048, model=SMALL)


def striped(level: int) -> np.ndarray:
    """A smooth picture, another for every view."""
    y, x = np.mgrid[:24, :40]
    wave = 128 + 90 * np.sin(0.2 * x + 0.1 * y + 0.3 * level)
    return np.repeat(wave[..., None], 3, axis=2).astype(np.uint8)


def trained(pictures, points=None, config=SHORT, seed: int = 0) -> NgpTrainer:
    trainer = NgpTrainer(pictures, points, config, seed=seed)
    for _ in trainer.steps():
        pass
    return trainer


def test_training_raises_the_quality_of_the_views(posed, points):
    pictures, config = posed(striped), replace(SHORT, iterations=150)
    before = NgpTrainer(pictures, points, config).field()
    after = trained(pictures, points, config).field()
    assert mean_psnr_db(after, pictures) > mean_psnr_db(before, pictures) + 6


def test_a_dataset_without_points_starts_with_every_cell(posed):
    pictures = posed(striped)
    trainer = NgpTrainer(pictures, None, SHORT)
    first = trainer.step()
    assert first.iteration == 1
    losses = [progress.loss for progress in trainer.steps()]
    assert np.mean(losses[-8:]) < 0.5 * first.loss


def test_points_say_which_cells_can_be_occupied(posed, points):
    def occupied(trainer: NgpTrainer) -> int:
        words = trainer.field().numbers.occupancy
        return int(np.unpackbits(words.view(np.uint8)).sum())

    with_points = NgpTrainer(posed(striped), points, SHORT)
    everything = NgpTrainer(posed(striped), None, SHORT)
    assert 0 < occupied(with_points) < 0.25 * occupied(everything)


@pytest.mark.parametrize("change", [{}, {"threads": 2}, {"threads": 5, "isa": "scalar"}])
def test_the_same_seed_gives_the_same_bytes(posed, points, change):
    config = replace(SHORT, iterations=12)
    first = trained(posed(striped), points, config).field(name="a")
    again = trained(posed(striped), points, replace(config, **change)).field(name="a")
    assert again.field_id == first.field_id


def test_another_seed_gives_another_field(posed, points):
    config = replace(SHORT, iterations=3)
    first, other = (trained(posed(striped), points, config, seed=seed) for seed in (0, 1))
    assert first.field().field_id != other.field().field_id
    assert first.training_digest != other.training_digest


def test_a_resumed_run_ends_with_the_same_bytes(posed, points, tmp_path):
    through = NgpTrainer(posed(striped), points, SHORT)
    interrupted = NgpTrainer(posed(striped), points, SHORT)
    for _ in range(17):
        interrupted.step()
    write_checkpoint(interrupted.checkpoint(), tmp_path / "a.rfc")
    resumed = NgpTrainer(posed(striped), points, SHORT)
    resumed.restore(read_checkpoint(tmp_path / "a.rfc"))
    assert resumed.iteration == 17
    for trainer in (through, resumed):
        for _ in trainer.steps():
            pass
    assert resumed.field().field_id == through.field().field_id


def test_a_checkpoint_of_another_run_is_refused(posed, points):
    first = NgpTrainer(posed(striped), points, SHORT)
    other = NgpTrainer(posed(striped), points, SHORT, seed=1)
    with pytest.raises(InvalidInput, match="checkpoint"):
        other.restore(first.checkpoint())


@pytest.mark.parametrize("paint", PAINTS.values(), ids=PAINTS.keys())
def test_no_step_on_poison_makes_a_number_infinite(posed, paint):
    far = np.array([[1e6, 0, 0], [0, 0, 3], [-0.4, 0, 0], [0, 0, 3]] * 4, np.float32)
    points = PointCloud(far, np.zeros((16, 3), np.uint8))
    config = replace(SHORT, schedule=NgpSchedule(rate=0.5, held_share=0.9))
    trainer = NgpTrainer(posed(paint), points, config)
    assert all(np.isfinite(loss) for loss in losses_until_it_diverges(trainer))
    trainer.field()  # raises on a number that is not finite


def losses_until_it_diverges(trainer: NgpTrainer) -> Iterator[float]:
    try:
        for progress in trainer.steps():
            yield progress.loss
    except TrainingDiverged as stopped:
        assert stopped.group in ("table", "matrices")  # noqa: PT017 - either ending is right


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: NgpTrainingConfig(iterations=0), "training.iterations: 0"),
        (lambda: NgpTrainingConfig(batch_samples=1), "training.batch_samples: 1"),
        (lambda: NgpSchedule(rate=float("nan")), "training.rate: nan"),
        (lambda: NgpSchedule(held_share=1.0), "training.held_share: 1"),
        (lambda: NgpSchedule(final_factor=0.0), "training.final_factor: 0"),
        (lambda: NgpSchedule(threshold=0.0), "training.threshold: 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(make, named):
    with pytest.raises(InvalidInput, match=named):
        make()
