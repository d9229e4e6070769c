"""The trainer's own settings are good enough for the sample street."""

from pathlib import Path

import pytest

from rfcore.dataset import read_dataset
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.trainer import mean_psnr_db

SAMPLE = Path(__file__).parents[2] / "samples" / "street"


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.timeout(900)
def test_the_held_out_drive_of_the_sample_reaches_26_db():
    train = read_dataset(SAMPLE / "transforms_train.json")
    held_out = read_dataset(SAMPLE / "transforms_drive_empty.json")
    assert train.points is not None
    trainer = SplatTrainer(train.pictures, train.points, SplatTrainingConfig(threads=2))
    for _ in trainer.steps():
        pass
    assert mean_psnr_db(trainer.field(), held_out.pictures) >= 26.0
