"""Schedules of a training run: step sizes, bands, the order of the views, density control.

``progress`` runs from 0 at the first iteration towards 1 after the last.

Density control: between ``start`` and ``stop`` of the run, every ``interval`` iterations, the
Gaussians that show nothing are replaced and the set grows by ``growth``, up to ``limit``. How the
sources are drawn and split is ``DensityStep``'s; docs/how-to/training.md compares the rules.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import MAX_GAUSSIANS
from rfcore.raster.trainable import DensityStep, LearningRates, TrainableRasterizer

ORDER_INTERVAL = 500
"""Iterations between two sorts along the curve. A round of density control appends new Gaussians in
the order of their sources, so the order degrades only over many rounds."""
NOISE_INTERVAL = 10
"""Iterations between two random moves of faint Gaussians; smaller moves more often do the same."""


@dataclass(frozen=True)
class RateSchedule:
    """Adam's step sizes: constant for a while, then falling exponentially.

    Measured on the first sample with 150k Gaussians and 1500 iterations: 27.1 dB held out.
    Means at 0.2 and scales at 1e-2 gave 26.5 dB; rates that suit 30,000 iterations about 25 dB.
    """

    means: float = 0.04
    """Rate in units of the median initial standard deviation, which suits any unit of length."""
    log_scales: float = 2.5e-2
    quaternions: float = 5e-3
    opacity_logits: float = 5e-2
    sh_dc: float = 1e-2
    sh_rest: float = 1e-3
    held_share: float = 0.7
    """Share of the run with constant rates."""
    final_factor: float = 0.02
    """Factor on every rate at the end."""
    means_fall: float = 0.1
    """A further factor on the means' rate at the end, reached by falling during the whole run."""

    def __post_init__(self) -> None:
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
            if not 0 <= getattr(self, name) <= 10:
                raise InvalidInput(f"rates.{name}", f"{getattr(self, name)} is outside 0..10")
        if not 0 <= self.held_share < 1:
            raise InvalidInput("rates.held_share", f"{self.held_share} is outside 0..1")
        for name in ("final_factor", "means_fall"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidInput(f"rates.{name}", f"{getattr(self, name)} is outside 0..1")

    def factor(self, progress: float) -> float:
        """Return the factor on the rates at ``progress``, which starts at 1."""
        fall = max(0.0, (progress - self.held_share) / (1.0 - self.held_share))
        return float(self.final_factor**fall)

    def at(self, progress: float, unit_m: float) -> LearningRates:
        """Return the rates at ``progress``; ``unit_m`` is the median initial deviation."""
        factor = self.factor(progress)
        return LearningRates(
            means=self.means * unit_m * factor * self.means_fall**progress,
            log_scales=self.log_scales * factor,
            quaternions=self.quaternions * factor,
            opacity=self.opacity_logits * factor,
            sh_dc=self.sh_dc * factor,
            sh_rest=self.sh_rest * factor,
        )


@dataclass(frozen=True)
class Regularisation:
    """Weights of the mean opacity and the mean scale in metres, which are added to the loss.

    MCMC (Kheradmand et al. 2024, eq. 10) takes 0.01 for both: it makes Gaussians that do not pay
    for themselves fade, and with that frees them for density control.
    """

    opacity: float = 0.0
    scale: float = 0.0

    def __post_init__(self) -> None:
        for name in ("opacity", "scale"):
            if not 0 <= getattr(self, name) <= 10:
                raise InvalidInput(f"regularisation.{name}", f"{getattr(self, name)} not in 0..10")

    def added_to(self, rates: LearningRates, count: int) -> LearningRates:
        """Return ``rates`` with the pulls on each of ``count`` Gaussians."""
        per_gaussian = 1.0 / max(count, 1)
        return replace(
            rates,
            opacity_pull=self.opacity * per_gaussian,
            scale_pull=self.scale * per_gaussian / 3.0,
        )


@dataclass(frozen=True)
class Bands:
    """The bands of the spherical harmonics that are learned, and when they join."""

    degree: int = 3
    """Degree of the field, 0..3."""
    rise: float = 0.0
    """Share of the run after which one more band joins, beginning with none; 0 has all at once."""

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= 3:
            raise InvalidInput("bands.degree", f"{self.degree} is outside 0..3")
        if not 0 <= self.rise <= 0.3:
            raise InvalidInput("bands.rise", f"{self.rise} is outside 0..0.3")

    def at(self, progress: float) -> int:
        """Return the degree in use at ``progress``."""
        return self.degree if self.rise == 0 else min(self.degree, int(progress / self.rise))


def view_order(views: int, rng: np.random.Generator) -> Iterator[int]:
    """Yield view indices for ever: every view once, in random order, then all again."""
    while True:
        yield from rng.permutation(views).tolist()


@dataclass(frozen=True)
class DensityControl:
    """Settings of density control; ``limit`` 0 keeps the first set of Gaussians."""

    limit: int = 0
    """Most Gaussians, including those of the start."""
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
    """Size of random moves of faint Gaussians, in their standard deviations, at full rate."""

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
    """Do a round of density control, and move faint Gaussians, if ``control`` has them due."""
    if control.is_due(iteration, progress):
        rasterizer.control_density(control.step_after(iteration, len(rasterizer), seed))
    if control.noise > 0 and iteration % NOISE_INTERVAL == 0 and progress < control.stop:
        rasterizer.perturb(control.noise, _seed_of(seed, iteration) ^ 1)


def is_order_due(control: DensityControl, iteration: int, progress: float) -> bool:
    """Return whether Gaussians are sorted along the curve again after ``iteration``."""
    return iteration % ORDER_INTERVAL == 0 and control.is_due(iteration, progress)


def _seed_of(seed: int, iteration: int) -> int:
    """Return a seed of its own for each iteration, so that a resumed run draws the same."""
    state = np.random.SeedSequence([seed, iteration]).generate_state(1, np.uint64)
    return int(state[0])
