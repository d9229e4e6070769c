"""Light the street by a sun 6 degrees above the horizon: long shadows, warm light, a blue sky."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.sky import DUSK, Daylight, sunny_sky
from streetgen.geometry.world import World


@dataclass(frozen=True)
class Dusk:
    """The sun's direction (``azimuth_deg`` from x towards y), haze and clouds."""

    azimuth_deg: Annotated[float, Range(-360, 360)] = DUSK.azimuth_deg
    elevation_deg: Annotated[float, Range(1, 20)] = DUSK.elevation_deg
    turbidity: Annotated[float, Range(1.8, 10)] = DUSK.turbidity
    cover: Annotated[float, Range(0, 0.9)] = DUSK.cover

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world under the evening's sky."""
        day = Daylight(
            self.azimuth_deg, self.elevation_deg, self.turbidity, self.cover, white=DUSK.white
        )
        return replace(world, sky=sunny_sky(day, rng))
