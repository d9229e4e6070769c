"""Wet the ground: water darkens it, and puddles mirror the street.

Smoothness varies in patches between wet and dry, because ground is uneven. Water in its pores makes
stone about half as bright (Lekner and Dorf, "Why some things are darker when wet", Applied Optics
1988).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.grain import fractal
from streetgen.geometry.mesh import F32, Colour, Material, Texture
from streetgen.geometry.world import World

GROUND = ("asphalt", "slabs", "kerb", "paint", "iron")
MAP_PX = 512
SMOOTHEST, ROUGHEST = 0.04, 0.6
DARKENED = 0.5
"""The linear reflectance of wet ground divided by that of dry ground."""
DISPLAY_EXPONENT = 1 / 2.2


@dataclass(frozen=True)
class WetRoad:
    """The amount of ``water``, from 0 (damp) to 1 (mostly puddles)."""

    water: Annotated[float, Range(0, 1)] = 0.5

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world with wet road and pavement."""
        for name in GROUND:
            if name in world.materials:
                world = world.with_material(self._wet(world.materials[name], rng))
        return world

    def _wet(self, dry: Material, rng: np.random.Generator) -> Material:
        return replace(dry, colour=_darkened(dry.colour), roughness=self._puddles(rng))

    def _puddles(self, rng: np.random.Generator) -> F32:
        """Return the roughness [H, W], which is low in the hollows."""
        height = fractal((MAP_PX, MAP_PX), 3.2, rng)
        level = 2.4 * (self.water - 0.5)
        dry = 1 / (1 + np.exp(-4 * (height - level)))
        return np.asarray(SMOOTHEST + (ROUGHEST - SMOOTHEST) * dry, np.float32)


def _darkened(colour: Colour | Texture) -> Colour | Texture:
    if isinstance(colour, np.ndarray):
        return np.asarray(np.round(colour * DARKENED**DISPLAY_EXPONENT), np.uint8)
    red, green, blue = colour
    return DARKENED * red, DARKENED * green, DARKENED * blue
