"""Change the exposure late after steps of the light, and overshoot (hunting).

The exposure answers a step as an under-damped system does: after t seconds the gain has covered the
share 1 - exp(-t / settle_s) cos(2 pi t / period_s) of the step. The times of the steps are
declared, because a frame is made without those before it. A tunnel is two steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.tables import Range
from streetgen.frame import LinearFrame


@dataclass(frozen=True)
class AutoExposure:
    """The steps of the exposure, in stops: ``steps[i]`` begins at the time ``at_s[i]``."""

    at_s: Annotated[tuple[float, ...], Range(0, 3600)] = (0.5, 1.5)
    steps: Annotated[tuple[float, ...], Range(-8, 8)] = (0.8, -0.8)
    settle_s: Annotated[float, Range(0.01, 60)] = 0.4
    period_s: Annotated[float, Range(0.05, 60)] = 0.6

    def __post_init__(self) -> None:
        if len(self.steps) != len(self.at_s):
            raise InvalidInput("steps", f"are {len(self.steps)} at {len(self.at_s)} times")

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Multiply the light by the gain of the frame's time."""
        stops = sum(
            step * self._answered(frame.time_s - at_s)
            for at_s, step in zip(self.at_s, self.steps, strict=True)
        )
        return replace(frame, colour=frame.colour * np.float32(2.0**stops))

    def _answered(self, after_s: float) -> float:
        if after_s <= 0:
            return 0.0
        swing = math.cos(2 * math.pi * after_s / self.period_s)
        return 1.0 - math.exp(-after_s / self.settle_s) * swing
