"""Overcast: a closed layer of cloud, soft light from everywhere and no shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfedge.street.geometry.sky import overcast_sky
from rfedge.street.geometry.world import World
from rfedge.street.schema import Range

__all__ = ["Overcast"]


@dataclass(frozen=True)
class Overcast:
    """``zenith_kcd``: luminance overhead, kcd/m^2; it matters beside lamps, not alone."""

    zenith_kcd: Annotated[float, Range(0.1, 50)] = 9.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world under a grey sky."""
        return replace(world, sky=overcast_sky(self.zenith_kcd, rng))
