"""What changes over a training run: step sizes, the order of the views, the picture size.

``progress`` runs from 0 at the first iteration towards 1 after the last.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.raster.trainable import LearningRates

__all__ = ["Bands", "RateSchedule", "Regularisation", "view_order"]


@dataclass(frozen=True)
class RateSchedule:
    """Adam's step sizes: constant for a while, then falling exponentially.

    Measured on the first sample with 150k Gaussians and 1500 iterations: 27.1 dB held out.
    Means at 0.2 and scales at 1e-2 gave 26.5 dB; rates that suit 30,000 iterations about 25 dB.
    """

    means: float = 0.04
    """In units of the median initial standard deviation, so that it suits any unit of length."""
    log_scales: float = 2.5e-2
    quaternions: float = 5e-3
    opacity_logits: float = 5e-2
    sh_dc: float = 1e-2
    sh_rest: float = 1e-3
    held_share: float = 0.7
    """Share of the run with constant rates."""
    final_factor: float = 0.02
    """What is left of every rate at the end."""
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
        """Return what is left of the rates at ``progress``, 1 to begin with."""
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
    """What is added to the loss: so much times the mean opacity and the mean scale in metres.

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
    """Which bands of the spherical harmonics are learned, and from when."""

    degree: int = 3
    """The field's, 0..3."""
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
