"""The loop around a trainer: time-limited runs, measurements, checkpoints, whatever is trained."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from rfcore.errors import InvalidInput, TrainingDiverged
from rfcore.train.trainer import Checkpoint, TrainingProgress
from rfedge.training.loop import LoopLimits, LoopStatus, TrainingLoop, run_showing


class Steps:
    """A trainer that only counts, and a clock its iterations move on."""

    kind, training_digest, primitives = "steps", "d" * 64, 7

    def __init__(self, total: int, fails_at: int = 0) -> None:
        self.iteration, self.total, self.fails_at = 0, total, fails_at
        self.now_s = 100.0
        self.progress: list[float | None] = []

    @property
    def finished(self) -> bool:
        return self.iteration >= self.total

    def step(self, progress: float | None = None) -> TrainingProgress:
        self.progress.append(progress)
        self.iteration += 1
        self.now_s += 2.0
        if self.iteration == self.fails_at:
            raise TrainingDiverged(self.iteration, "means", "off")
        return TrainingProgress(self.iteration, self.total, 1.0 / self.iteration)

    def field(self, *_: Any) -> "Steps":
        return self

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            self.kind, self.training_digest, self.iteration, {"a": 1}, {"x": np.zeros(3)}
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        self.iteration = checkpoint.iteration


def loop_of(steps: Steps, limits: LoopLimits, measuring_s: float = 0.0) -> TrainingLoop:
    def measure(_: object) -> float:
        steps.now_s += measuring_s
        return 20.0 + steps.iteration

    return TrainingLoop(steps, limits, measure, lambda: steps.now_s)


def statuses(loop: TrainingLoop) -> list[LoopStatus]:
    told: list[LoopStatus] = []
    loop.run(told.append)
    return told


def test_a_run_limited_by_iterations_leaves_progress_to_the_trainer():
    steps = Steps(10)
    told = statuses(loop_of(steps, LoopLimits()))
    assert steps.progress == [None] * 10
    assert [status.progress for status in told] == pytest.approx([i / 10 for i in range(1, 11)])


def test_a_run_limited_by_time_ends_by_the_clock_and_tells_the_trainer_how_far_it_is():
    steps = Steps(1_000_000)
    loop = loop_of(steps, LoopLimits(minutes=1.0))
    statuses(loop)
    assert steps.iteration == 30
    assert steps.progress == pytest.approx([i / 30 for i in range(30)])
    assert loop.seconds == pytest.approx(60.0)


def test_measuring_takes_no_training_time():
    loop = loop_of(Steps(30), LoopLimits(measurements=5), measuring_s=500.0)
    statuses(loop)
    assert loop.seconds == pytest.approx(60.0)
    assert [s for s, _ in loop.curve] == pytest.approx([12, 24, 36, 48, 60])


def test_minutes_are_those_of_the_whole_run():
    """Measuring takes 5 s twice, and 20 s are kept for the last one and what follows."""
    steps = Steps(1_000_000)
    limits = LoopLimits(minutes=2.0, measurements=2, kept_s=20.0)
    loop = loop_of(steps, limits, measuring_s=5.0)
    told = statuses(loop)
    assert loop.seconds == pytest.approx(95.0, abs=2.0)
    assert (told[0].left_s, told[-1].left_s) == pytest.approx((118.0, 15.0), abs=2.0)


def test_what_came_before_the_loop_counts():
    steps = Steps(1_000_000)
    limits = LoopLimits(minutes=1.0, measurements=0)
    statuses(TrainingLoop(steps, limits, None, lambda: steps.now_s, begun_s=20.0))
    assert steps.iteration == 20


def test_the_curve_has_so_many_points_and_ends_at_the_end():
    steps = Steps(24)
    loop = loop_of(steps, LoopLimits(measurements=4))
    told = statuses(loop)
    assert loop.curve == [(12.0, 26.0), (24.0, 32.0), (36.0, 38.0), (48.0, 44.0)]
    assert told[0].psnr_db is None
    assert told[-1].psnr_db == 44.0


def test_without_measurements_there_is_no_curve():
    loop = loop_of(Steps(5), LoopLimits(measurements=0), measuring_s=9.0)
    assert all(status.psnr_db is None for status in statuses(loop))
    assert (loop.curve, loop.seconds) == ([], 10.0)


@pytest.fixture
def checkpoint_path(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "run.ckpt"
    assert not list(tmp_path.glob("*.part"))


def test_a_resumed_run_goes_on_counting_seconds_and_its_curve(checkpoint_path):
    limits = LoopLimits(checkpoint=checkpoint_path, checkpoint_every=4, measurements=4)
    broken = Steps(12, fails_at=11)
    with pytest.raises(TrainingDiverged):
        statuses(loop_of(broken, limits))
    resumed = loop_of(Steps(12), limits)
    resumed.resume()
    assert (resumed.trainer.iteration, resumed.seconds) == (8, 16.0)
    statuses(resumed)
    assert resumed.seconds == pytest.approx(24.0)
    assert [s for s, _ in resumed.curve] == pytest.approx([6.0, 12.0, 18.0, 24.0])


def test_a_resumed_run_of_minutes_goes_on_counting_them(checkpoint_path):
    limits = LoopLimits(1.0, checkpoint=checkpoint_path, checkpoint_every=10, measurements=0)
    with pytest.raises(TrainingDiverged):
        statuses(loop_of(Steps(1_000_000, fails_at=11), limits))
    resumed = loop_of(Steps(1_000_000), limits)
    resumed.resume()
    assert resumed.left_s == pytest.approx(40.0)
    statuses(resumed)
    assert resumed.trainer.iteration == 30


def test_the_last_good_checkpoint_survives_a_run_that_diverges(checkpoint_path):
    limits = LoopLimits(checkpoint=checkpoint_path, checkpoint_every=3)
    with pytest.raises(TrainingDiverged, match="iteration 7, means"):
        statuses(loop_of(Steps(12, fails_at=7), limits))
    loop = loop_of(Steps(12), limits)
    loop.resume()
    assert loop.trainer.iteration == 6


def test_resuming_needs_a_checkpoint():
    with pytest.raises(InvalidInput, match="resume"):
        loop_of(Steps(3), LoopLimits()).resume()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"minutes": 0.0}, "minutes"),
        ({"minutes": float("nan")}, "minutes"),
        ({"checkpoint_every": 0}, "checkpoint_every"),
        ({"measurements": -1}, "measurements"),
    ],
)
def test_limits_that_make_no_sense_are_refused(change, named):
    with pytest.raises(InvalidInput, match=named):
        LoopLimits(**change)


def test_a_log_gets_a_line_at_each_twentieth_with_the_time_left():
    steps, log = Steps(200), io.StringIO()
    run_showing(loop_of(steps, LoopLimits()), Console(file=log, width=200), lambda: steps.now_s)
    lines = log.getvalue().splitlines()
    assert len(lines) == 20
    assert lines[9].startswith("  50%: 100 iterations, 7 primitives, loss 0.0100")
    assert lines[9].endswith(", 3 min left")  # 100 steps of 2 s


def test_what_showing_the_field_takes_is_no_time_of_training():
    steps, shown = Steps(5), []

    def show(trainer: Any) -> None:
        shown.append(trainer.iteration)
        steps.now_s += 50.0

    loop = TrainingLoop(steps, LoopLimits(), None, lambda: steps.now_s, show)
    loop.run(lambda _: None)
    assert shown == [1, 2, 3, 4, 5]
    assert loop.seconds == 10.0
