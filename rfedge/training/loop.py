"""The loop around a trainer: time, measurements, checkpoints, progress on the console.

The loop takes any ``FieldTrainer``. It counts seconds of training, without the time for measuring
and for reading pictures. A limit in minutes counts measuring, too, and what follows the training. A
resumed run goes on counting where it stopped. Progress is a bar on a terminal, and a line at each
twentieth of the run in a log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rfcore.errors import InvalidInput, RfedgeError
from rfcore.field import RadianceField
from rfcore.train.trainer import FieldTrainer, read_checkpoint, write_checkpoint
from rfedge.arguments import time_text

Result = TypeVar("Result")
Measure = Callable[[RadianceField], float]
MAX_MINUTES = 7 * 24 * 60.0


@dataclass(frozen=True)
class LoopLimits:
    """The end of a run, and the intervals of its checkpoints and measurements."""

    minutes: float | None = None
    """Length of the whole run, instead of the trainer's iterations."""
    kept_s: float = 0.0
    """The part of ``minutes`` that is kept for what follows the training."""
    checkpoint: Path | None = None
    checkpoint_every: int = 1000
    """Iterations between two checkpoints."""
    measurements: int = 12
    """Number of points of the curve of quality over time; 0: none is measured."""

    def __post_init__(self) -> None:
        if self.minutes is not None and not 0 < self.minutes <= MAX_MINUTES:
            raise InvalidInput("minutes", f"{self.minutes} is outside 0..{MAX_MINUTES:.0f}")
        if self.minutes is not None and not 0 <= self.kept_s < 60 * self.minutes:
            raise InvalidInput("kept_s", f"{self.kept_s} is outside 0..{60 * self.minutes:g}")
        if self.checkpoint_every < 1:
            raise InvalidInput("checkpoint_every", f"{self.checkpoint_every} must be at least 1")
        if not 0 <= self.measurements <= 1000:
            raise InvalidInput("measurements", f"{self.measurements} is outside 0..1000")


@dataclass(frozen=True)
class LoopStatus:
    """State of a run: ``progress`` 0..1 of the training, the last iteration's loss, the last
    measurement, and the seconds left of a run of so many minutes."""

    progress: float
    iteration: int
    loss: float
    primitives: int
    psnr_db: float | None
    left_s: float | None = None


class TrainingLoop:
    """Runs a trainer to its end. ``clock`` returns seconds that never go back.

    ``show`` is called with the trainer after each iteration (``rfedge.training.view``); its time
    does not count as training. ``begun_s``: seconds of the run before the loop, which count too.
    """

    def __init__(
        self,
        trainer: FieldTrainer,
        limits: LoopLimits,
        measure: Measure | None,
        clock: Callable[[], float],
        show: Callable[[FieldTrainer], None] | None = None,
        begun_s: float = 0.0,
    ) -> None:
        self.trainer = trainer
        self._show = show
        self.curve: list[tuple[float, float]] = []
        """Seconds of training and held-out PSNR in dB."""
        self._limits, self._measure, self._clock = limits, measure, clock
        self._before_s = self._aside_s = 0.0
        self._elapsed_before_s = begun_s
        self._started_s = clock()

    @property
    def seconds(self) -> float:
        """Seconds of training so far."""
        return self._before_s + self._clock() - self._started_s - self._aside_s

    @property
    def left_s(self) -> float | None:
        """Seconds of the whole run that are left; None for a run of a number of iterations."""
        if self._limits.minutes is None:
            return None
        return max(60 * self._limits.minutes - self._elapsed_s, 0.0)

    @property
    def _elapsed_s(self) -> float:
        return self._elapsed_before_s + self._clock() - self._started_s

    @property
    def kept_share(self) -> float:
        """The share of the whole run that is kept for what follows the training."""
        minutes = self._limits.minutes
        return 0.0 if minutes is None else self._limits.kept_s / (60 * minutes)

    @property
    def progress(self) -> float:
        """The share of the training that is done, 0..1."""
        minutes = self._limits.minutes
        if minutes is None:
            return self.trainer.iteration / self.trainer.total
        return min(self._elapsed_s / (60 * minutes - self._limits.kept_s), 1.0)

    def resume(self) -> None:
        """Go on after the checkpoint; raise ``InvalidInput`` if it belongs to another run."""
        if self._limits.checkpoint is None:
            raise InvalidInput("resume", "needs a checkpoint to go on from")
        checkpoint = read_checkpoint(self._limits.checkpoint)
        self.trainer.restore(checkpoint)
        loop = checkpoint.values["loop"]
        self._before_s = float(loop["seconds"])
        self._elapsed_before_s += float(loop["elapsed_s"])
        self.curve = [(float(s), float(db)) for s, db in loop["curve"]]
        self._started_s, self._aside_s = self._clock(), 0.0

    def run(self, tell: Callable[[LoopStatus], None]) -> None:
        """Train to the end; call ``tell`` with the status after every iteration.

        Raises ``TrainingDiverged``; the last good checkpoint stays.
        """
        self._started_s, self._aside_s = self._clock(), 0.0
        limits, trainer = self._limits, self.trainer
        while not trainer.finished and self.progress < 1.0:
            done = trainer.step(None if limits.minutes is None else self.progress)
            if limits.checkpoint is not None and trainer.iteration % limits.checkpoint_every == 0:
                self._save(limits.checkpoint)
            if self._measure is not None and self._measurement_is_due():
                self._take_measurement(self._measure)
            if self._show is not None:
                self._aside(partial(self._show, trainer))
            tell(
                LoopStatus(
                    progress=self.progress,
                    iteration=trainer.iteration,
                    loss=done.loss,
                    primitives=trainer.primitives,
                    psnr_db=self.curve[-1][1] if self.curve else None,
                    left_s=self.left_s,
                )
            )

    def _measurement_is_due(self) -> bool:
        points = self._limits.measurements
        ended = self.trainer.finished or self.progress >= 1.0
        return points > 0 and (ended or self.progress >= (len(self.curve) + 1) / points)

    def _take_measurement(self, measure: Measure) -> None:
        at_s = self.seconds
        self.curve.append((at_s, self._aside(lambda: measure(self.trainer.field()))))

    def _aside(self, work: Callable[[], Result]) -> Result:
        """Do work that is not training, and leave its time out."""
        before_s = self._clock()
        done = work()
        self._aside_s += self._clock() - before_s
        return done

    def _save(self, path: Path) -> None:
        checkpoint = self.trainer.checkpoint()
        loop = {"seconds": self.seconds, "elapsed_s": self._elapsed_s, "curve": self.curve}
        write_checkpoint(replace(checkpoint, values={**checkpoint.values, "loop": loop}), path)


STEPS = 1000
"""Steps of the progress bar; progress is a share of time or of iterations."""
LINES = 20


def run_showing(loop: TrainingLoop, console: Console, now_s: Callable[[], float]) -> None:
    """Run ``loop`` to its end and show iterations, loss, held-out quality and time left."""
    if console.is_terminal:
        _with_bar(loop, console)
    else:
        loop.run(_Lines(console, now_s))


def _with_bar(loop: TrainingLoop, console: Console) -> None:
    columns = (
        BarColumn(),
        TextColumn("{task.fields[state]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("train", total=STEPS, state="")

        def tell(status: LoopStatus) -> None:
            done = STEPS * status.progress * (1 - loop.kept_share)
            bar.update(task, completed=done, state=_state(status))

        try:
            loop.run(tell)
        except RfedgeError:
            bar.stop()
            raise


class _Lines:
    """Prints a line at each twentieth; the time left is that of the minutes asked for, or follows
    from the pace since the start."""

    def __init__(self, console: Console, now_s: Callable[[], float]) -> None:
        self._console, self._now_s = console, now_s
        self._start: tuple[float, float] | None = None
        self._printed = 0

    def __call__(self, status: LoopStatus) -> None:
        now_s = self._now_s()
        if self._start is None:
            self._start, self._printed = (now_s, status.progress), int(LINES * status.progress)
        if int(LINES * status.progress) == self._printed:
            return
        self._printed = int(LINES * status.progress)
        start_s, start_progress = self._start
        pace_s = (now_s - start_s) / max(status.progress - start_progress, 1e-9)
        left_s = pace_s * (1.0 - status.progress) if status.left_s is None else status.left_s
        done = f"{status.progress:.0%}: {_state(status)}, {time_text(left_s)} left"
        self._console.print(f"  {done}", soft_wrap=True)


def _state(status: LoopStatus) -> str:
    quality = f", held out {status.psnr_db:.2f} dB" if status.psnr_db is not None else ""
    return (
        f"{status.iteration:,} iterations, {status.primitives:,} primitives, "
        f"loss {status.loss:.4f}{quality}"
    )
