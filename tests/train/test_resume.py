"""A run that was interrupted ends with the same bytes as one that was not."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.train.schedule import Bands, DensityControl, Regularisation
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.trainer import read_checkpoint, write_checkpoint

PLAIN = SplatTrainingConfig(gaussians=200, iterations=40)
EVERYTHING = replace(
    PLAIN,
    density=DensityControl(
        limit=300, drawn_by="opacity", split="in_place", interval=7, noise=0.5, stop=0.9
    ),
    regularisation=Regularisation(0.01, 0.01),
    bands=Bands(rise=0.1),
    halved_until=(0.7, 0.3),
    antialiased=True,
    exposure=True,
)
BY_GRADIENT = replace(
    EVERYTHING,
    density=replace(EVERYTHING.density, drawn_by="gradient", split="long_axis"),
    exposure=False,
)


def squares(view: int) -> np.ndarray:
    y, x = np.mgrid[:24, :40]
    plane = 60 + 30 * view + 80 * ((x // 8 + y // 8) % 2)
    return np.repeat(plane[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("config", [PLAIN, EVERYTHING, BY_GRADIENT], ids=["plain", "all", "grad"])
@pytest.mark.parametrize("at", [1, 23])
def test_a_resumed_run_gives_the_bytes_of_an_uninterrupted_one(posed, points, tmp_path, config, at):
    pictures = posed(squares)
    whole = SplatTrainer(pictures, points, config, seed=4)
    list(whole.steps())
    broken = SplatTrainer(pictures, points, config, seed=4)
    list(islice(broken.steps(), at))
    write_checkpoint(broken.checkpoint(), tmp_path / "run.ckpt")
    resumed = SplatTrainer(pictures, points, replace(config, threads=2), seed=4)
    resumed.restore(read_checkpoint(tmp_path / "run.ckpt"))
    assert resumed.iteration == at
    list(resumed.steps())
    assert resumed.field().field_id == whole.field().field_id


def test_a_checkpoint_of_another_run_is_refused(posed, points):
    one, other = (SplatTrainer(posed(squares), points, PLAIN, seed=seed) for seed in (1, 2))
    with pytest.raises(InvalidInput, match="same pictures, settings and seed"):
        other.restore(one.checkpoint())


def test_a_damaged_checkpoint_is_refused(posed, points, tmp_path):
    path = tmp_path / "run.ckpt"
    write_checkpoint(SplatTrainer(posed(squares), points, PLAIN).checkpoint(), path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(FieldFormatError, match=r"run\.ckpt"):
        read_checkpoint(path)


def test_a_field_is_no_checkpoint(posed, points, tmp_path):
    from rfcore.field import save_field

    path = tmp_path / "a.rff"
    save_field(SplatTrainer(posed(squares), points, PLAIN).field(), path)
    with pytest.raises(FieldFormatError, match="not a checkpoint"):
        read_checkpoint(path)
