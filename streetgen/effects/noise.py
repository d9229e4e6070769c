"""Add the noise of a sensor: Poisson-distributed photons and a normal readout error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.frame import LinearFrame


@dataclass(frozen=True)
class SensorNoise:
    """The electrons of a white pixel, and the standard deviation of the readout."""

    full_well_e: Annotated[float, Range(50, 1e6)] = 3000.0
    read_e: Annotated[float, Range(0, 1000)] = 4.0

    def apply(self, frame: LinearFrame, rng: np.random.Generator) -> LinearFrame:
        """Count electrons and turn them back into light."""
        electrons = np.clip(frame.colour, 0.0, 4.0) * self.full_well_e
        counted = rng.poisson(electrons) + rng.normal(0.0, self.read_e, electrons.shape)
        return replace(frame, colour=(counted / self.full_well_e).astype(np.float32))
