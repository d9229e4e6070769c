"""Haze: Koschmieder's law, light is lost with distance and replaced by the air's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfedge.street.frame import LinearFrame
from rfedge.street.schema import Range

__all__ = ["Haze"]


@dataclass(frozen=True)
class Haze:
    """``visibility_m``: where a black thing keeps 5 % contrast (the meteorological range)."""

    visibility_m: Annotated[float, Range(10, 100_000)] = 800.0
    air: Annotated[float, Range(0, 2)] = 0.55

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Mix each pixel with the air by its depth."""
        extinction = np.log(np.float32(20.0)) / np.float32(self.visibility_m)
        kept = np.exp(-extinction * frame.depth_m)[..., None]
        colour = frame.colour * kept + np.float32(self.air) * (1 - kept)
        return replace(frame, colour=colour.astype(np.float32))
