"""Roof a stretch of the road by a tunnel, which is dark inside.

Only daylight from its ends comes in (``auto_exposure`` says what the camera does about it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.classes import Label
from streetgen.geometry.mesh import Material
from streetgen.geometry.solids import Surface, boxes
from streetgen.geometry.world import StreetPart, World

CONCRETE = Surface("tunnel", Label.BUILDING)
WALL_M = 0.4


@dataclass(frozen=True)
class Tunnel:
    """The tunnel's begin along x, its length, and its height inside."""

    start_m: Annotated[float, Range(-1000, 1000)] = -10.0
    length_m: Annotated[float, Range(1, 500)] = 20.0
    height_m: Annotated[float, Range(3, 8)] = 5.5

    def change(self, world: World, _rng: np.random.Generator) -> World:
        """Return the world with the tunnel over its road."""
        start, end, top = self.start_m, self.start_m + self.length_m, self.height_m
        inner = world.layout.road_half_m
        outer = inner + WALL_M
        low = [(start, -outer, 0.0), (start, inner, 0.0), (start, -outer, top)]
        high = [(end, -inner, top), (end, outer, top), (end, outer, top + WALL_M)]
        material = Material(CONCRETE.material, (0.32, 0.31, 0.3))
        return world.plus(StreetPart((boxes(CONCRETE, low, high),), (material,)))
