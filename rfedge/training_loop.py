"""The loop around a trainer: time, measurements, checkpoints.

Any ``FieldTrainer`` will do. Seconds are those of training: neither the time measuring takes nor
that of reading the pictures counts, and a resumed run goes on counting where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.train import FieldTrainer, read_checkpoint, write_checkpoint

__all__ = ["LoopLimits", "LoopStatus", "TrainingLoop"]

Measure = Callable[[RadianceField], float]
MAX_MINUTES = 7 * 24 * 60.0


@dataclass(frozen=True)
class LoopLimits:
    """When a run ends, and what it leaves behind on the way."""

    minutes: float | None = None
    """End after so many minutes of training instead of at the trainer's iterations."""
    checkpoint: Path | None = None
    checkpoint_every: int = 1000
    """Iterations between two checkpoints."""
    measurements: int = 12
    """Points of the curve of quality over time; 0: none is measured."""

    def __post_init__(self) -> None:
        if self.minutes is not None and not 0 < self.minutes <= MAX_MINUTES:
            raise InvalidInput("minutes", f"{self.minutes} is outside 0..{MAX_MINUTES:.0f}")
        if self.checkpoint_every < 1:
            raise InvalidInput("checkpoint_every", f"{self.checkpoint_every} must be at least 1")
        if not 0 <= self.measurements <= 1000:
            raise InvalidInput("measurements", f"{self.measurements} is outside 0..1000")


@dataclass(frozen=True)
class LoopStatus:
    """Where a run is: ``progress`` 0..1, the loss of the last iteration, the last measurement."""

    progress: float
    iteration: int
    loss: float
    primitives: int
    psnr_db: float | None


class TrainingLoop:
    """Runs a trainer to its end. ``clock`` returns seconds that never go back."""

    def __init__(
        self,
        trainer: FieldTrainer,
        limits: LoopLimits,
        measure: Measure | None,
        clock: Callable[[], float],
    ) -> None:
        self.trainer = trainer
        self.curve: list[tuple[float, float]] = []
        """Seconds of training and held-out PSNR in dB."""
        self._limits, self._measure, self._clock = limits, measure, clock
        self._before_s = self._aside_s = 0.0
        self._started_s = clock()

    @property
    def seconds(self) -> float:
        """Seconds of training so far."""
        return self._before_s + self._clock() - self._started_s - self._aside_s

    @property
    def progress(self) -> float:
        """How far the run is, 0..1."""
        if self._limits.minutes is None:
            return self.trainer.iteration / self.trainer.total
        return min(self.seconds / (60 * self._limits.minutes), 1.0)

    def resume(self) -> None:
        """Go on after the checkpoint. Raises ``InvalidInput`` when it is of another run."""
        if self._limits.checkpoint is None:
            raise InvalidInput("resume", "needs a checkpoint to go on from")
        checkpoint = read_checkpoint(self._limits.checkpoint)
        self.trainer.restore(checkpoint)
        loop = checkpoint.values["loop"]
        self._before_s = float(loop["seconds"])
        self.curve = [(float(s), float(db)) for s, db in loop["curve"]]
        self._started_s, self._aside_s = self._clock(), 0.0

    def run(self, tell: Callable[[LoopStatus], None]) -> None:
        """Train to the end, telling where it is after every iteration.

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
            psnr_db = self.curve[-1][1] if self.curve else None
            tell(
                LoopStatus(self.progress, trainer.iteration, done.loss, trainer.primitives, psnr_db)
            )

    def _measurement_is_due(self) -> bool:
        points = self._limits.measurements
        ended = self.trainer.finished or self.progress >= 1.0
        return points > 0 and (ended or self.progress >= (len(self.curve) + 1) / points)

    def _take_measurement(self, measure: Measure) -> None:
        at_s, before_s = self.seconds, self._clock()
        self.curve.append((at_s, measure(self.trainer.field())))
        self._aside_s += self._clock() - before_s

    def _save(self, path: Path) -> None:
        checkpoint = self.trainer.checkpoint()
        loop = {"seconds": self.seconds, "curve": self.curve}
        write_checkpoint(replace(checkpoint, values={**checkpoint.values, "loop": loop}), path)
