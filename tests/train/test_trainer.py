"""Trainers of every kind share counting, divergence, metadata and settings of the digest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rfcore.camera import Camera, Intrinsics, Pose, TileOrigin
from rfcore.errors import InvalidInput, TrainingDiverged
from rfcore.field import FieldMetadata
from rfcore.train.ngp import NgpTrainingConfig
from rfcore.train.splats import SplatTrainingConfig
from rfcore.train.trainer import Checkpoint, FieldTrainer, HeldOut, settings_of
from rfcore.vertical import Sight

DIGEST = "ab" * 32


@dataclass(frozen=True)
class Parameters:
    small: np.ndarray
    large: np.ndarray


class Scripted(FieldTrainer):
    """A trainer whose losses are given."""

    kind = "splats"
    primitives = 3

    def __init__(self, losses: list[float], cameras: Sequence[Camera] = ()) -> None:
        super().__init__(len(losses), DIGEST, cameras)
        self.losses = losses
        self.descended: list[float] = []
        self.after: list[tuple[int, float]] = []

    def field(self, name="", tile_origin=None, held_out=None) -> FieldMetadata:
        return self._metadata(name, tile_origin, held_out, antialiased=True)

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(self.kind, DIGEST, self.iteration, {}, {})

    def restore(self, checkpoint: Checkpoint) -> None:
        self.iteration = checkpoint.iteration

    def _descend(self, progress: float) -> float:
        self.descended.append(progress)
        return self.losses[self.iteration]

    def _after_iteration(self, progress: float) -> None:
        self.after.append((self.iteration, progress))

    def _parameters(self) -> Parameters:
        return Parameters(np.ones(2), np.full(2, 5.0))


def test_progress_is_the_share_of_iterations_done_before_each():
    trainer = Scripted([0.4, 0.3, 0.2, 0.1])
    told = list(trainer.steps())
    assert trainer.descended == [0.0, 0.25, 0.5, 0.75]
    assert [(step.iteration, step.total, step.loss) for step in told] == [
        (1, 4, 0.4),
        (2, 4, 0.3),
        (3, 4, 0.2),
        (4, 4, 0.1),
    ]
    assert trainer.finished


def test_a_run_limited_by_time_passes_its_own_progress():
    trainer = Scripted([0.4, 0.3])
    trainer.step(0.9)
    assert trainer.descended == [0.9]
    assert trainer.after == [(1, 0.9)]


def test_a_finished_run_does_no_further_iteration():
    trainer = Scripted([0.4])
    trainer.step()
    with pytest.raises(InvalidInput, match="all 1 iterations are done"):
        trainer.step()
    assert trainer.iteration == len(trainer.descended) == 1


def test_a_loss_that_is_no_number_ends_the_run_with_its_iteration():
    trainer = Scripted([0.4, float("nan"), 0.1])
    with pytest.raises(TrainingDiverged, match="the loss is nan") as caught:
        list(trainer.steps())
    assert caught.value.iteration == trainer.iteration == 2


def test_a_restored_run_does_only_what_is_left():
    done, rest = Scripted([0.4, 0.3, 0.2]), Scripted([0.4, 0.3, 0.2])
    done.step()
    done.step()
    rest.restore(done.checkpoint())
    assert [step.loss for step in rest.steps()] == [0.2]


def test_metadata_states_the_run_and_what_was_measured():
    trainer = Scripted([0.4])
    origin = TileOrigin(1.0, 2.0, 3.0)
    assert trainer.field("street", origin, HeldOut(27.0, 0.8)) == FieldMetadata(
        "street", origin, DIGEST, 27.0, 0.8, antialiased=True
    )
    assert trainer.field() == FieldMetadata(training_digest=DIGEST, antialiased=True)


def test_metadata_states_what_the_cameras_show():
    level = Camera(Intrinsics(8, 6, 8.0, 8.0, 4.0, 3.0), Pose.identity())
    metadata = Scripted([0.4], [level]).field()
    assert metadata.up == (0.0, -1.0, 0.0)
    assert metadata.sights == (Sight((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),)
    assert metadata.focal_px == 8.0


@pytest.mark.parametrize("config", [SplatTrainingConfig(), NgpTrainingConfig()])
def test_threads_and_instruction_set_are_no_settings_of_the_result(config):
    elsewhere = replace(config, threads=7, isa="scalar")
    assert settings_of(elsewhere) == settings_of(config)
    assert settings_of(replace(config, iterations=17)) != settings_of(config)
