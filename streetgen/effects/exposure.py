"""Vary the exposure by a slow wave, as automatic exposure does between sun and shade."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.frame import LinearFrame


@dataclass(frozen=True)
class ExposureDrift:
    """The wave's amplitude in stops and its period."""

    stops: Annotated[float, Range(0, 4)] = 0.3
    period_s: Annotated[float, Range(0.1, 3600)] = 4.0

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Multiply the light by the gain of the frame's time."""
        gain = 2.0 ** (self.stops * math.sin(2 * math.pi * frame.time_s / self.period_s))
        return replace(frame, colour=frame.colour * np.float32(gain))
