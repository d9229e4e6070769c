"""When Gaussians end and when new ones join, over a training run.

Between ``start`` and ``stop`` of the run, every ``interval`` iterations, the Gaussians that show
nothing are replaced and the set grows by ``growth``, up to ``limit``. How the sources are drawn and
split is ``DensityStep``'s; docs/training.md compares the rules.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import MAX_GAUSSIANS
from rfcore.raster.trainable import DensityStep, TrainableRasterizer

__all__ = ["DensityControl", "control_density"]

NOISE_INTERVAL = 10
"""Iterations between two moves of the faint: moving them by less, more often, gives the same."""


@dataclass(frozen=True)
class DensityControl:
    """How the set of Gaussians changes; ``limit`` 0 keeps the set it starts with."""

    limit: int = 0
    """At most so many Gaussians; the ones the run starts with count."""
    drawn_by: Literal["opacity", "gradient"] = "gradient"
    split: Literal["in_place", "long_axis"] = "long_axis"
    interval: int = 100
    """Iterations between two rounds."""
    growth: float = 0.05
    """Share by which the set grows in a round, 0..1."""
    start: float = 0.05
    stop: float = 0.6
    """Shares of the run between which rounds take place."""
    noise: float = 0.0
    """Random moves of the faint, in their own deviations, at full learning rate."""

    def __post_init__(self) -> None:
        if not 0 <= self.limit <= MAX_GAUSSIANS:
            raise InvalidInput("density.limit", f"{self.limit} is outside 0..{MAX_GAUSSIANS}")
        if self.interval < 1:
            raise InvalidInput("density.interval", f"{self.interval} must be at least 1")
        if not 0 <= self.growth <= 1:
            raise InvalidInput("density.growth", f"{self.growth} is outside 0..1")
        if not 0 <= self.start <= self.stop <= 1:
            raise InvalidInput("density.start", f"{self.start}..{self.stop} is not within 0..1")
        if not 0 <= self.noise <= 10:
            raise InvalidInput("density.noise", f"{self.noise} is outside 0..10")

    def is_due(self, iteration: int, progress: float) -> bool:
        """Return whether a round follows iteration ``iteration``, counted from 1."""
        return (
            self.limit > 0 and iteration % self.interval == 0 and self.start <= progress < self.stop
        )

    def step_after(self, iteration: int, count: int, seed: int) -> DensityStep:
        """Return the round after ``iteration`` for a set of ``count``."""
        added = min(int(count * self.growth), max(self.limit - count, 0))
        return DensityStep(
            added=added,
            seed=_seed_of(seed, iteration),
            by_gradient=self.drawn_by == "gradient",
            in_place=self.split == "in_place",
        )


def control_density(
    rasterizer: TrainableRasterizer,
    control: DensityControl,
    iteration: int,
    progress: float,
    seed: int,
) -> None:
    """Do what ``control`` asks for after an iteration."""
    if control.is_due(iteration, progress):
        rasterizer.control_density(control.step_after(iteration, len(rasterizer), seed))
    if control.noise > 0 and iteration % NOISE_INTERVAL == 0 and progress < control.stop:
        rasterizer.perturb(control.noise, _seed_of(seed, iteration) ^ 1)


def _seed_of(seed: int, iteration: int) -> int:
    """Return a seed of its own for each iteration, so that a resumed run draws the same."""
    state = np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint64)
    return int(state[0])
