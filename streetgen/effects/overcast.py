"""Close the sky by a layer of cloud: soft light from everywhere and no shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.sky import overcast_sky
from streetgen.geometry.world import World


@dataclass(frozen=True)
class Overcast:
    """The layer of cloud and the exposure.

    ``unevenness`` is the deviation of the layer's brightness, ``white`` the linear light of a level
    white sheet in the picture.
    """

    unevenness: Annotated[float, Range(0, 1)] = 0.22
    white: Annotated[float, Range(0.05, 5)] = 1.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world under a grey sky."""
        return replace(world, sky=overcast_sky(self.unevenness, self.white, rng))
