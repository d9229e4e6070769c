"""Bark, leaves and soil, painted once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rfedge.street.geometry.grain import fractal, speckle, texture, tinted
from rfedge.street.geometry.material import Material, Texture

__all__ = ["tree_materials"]

SIZE = (256, 256)


@lru_cache(maxsize=1)
def tree_materials() -> tuple[Material, ...]:
    """Return what trees and their pits are made of; the same objects at each call."""
    rng = np.random.default_rng(11)
    return (
        Material("bark", _bark(rng)),
        Material("leaf", _leaf_shades(rng), roughness=0.9, transmission=0.0),
        Material("soil", _soil(rng)),
        Material("tree guard", (0.05, 0.045, 0.04), roughness=0.6, metallic=0.5),
    )


def _bark(rng: np.random.Generator) -> Texture:
    """Furrows along v."""
    furrows = fractal((64, 256), 1.6, rng).repeat(4, axis=0)
    painted = tinted(SIZE, (104, 92, 76)) * (1 - 0.16 * np.clip(furrows, -1.5, 2.5))[..., None]
    return texture(painted + 7 * speckle(SIZE, 1.0, rng)[..., None])


def _leaf_shades(rng: np.random.Generator) -> Texture:
    """Each leaf takes one place of it: yellower along u, darker along v."""
    u, v = np.meshgrid(np.linspace(0, 1, SIZE[1]), np.linspace(0, 1, SIZE[0]))
    colour = np.stack([74 + 46 * u, 108 + 22 * u, 40 + 6 * u], axis=2) * (1.2 - 0.5 * v)[..., None]
    return texture((colour * (1 + 0.05 * fractal(SIZE, 2.0, rng))[..., None]).astype(np.float32))


def _soil(rng: np.random.Generator) -> Texture:
    painted = tinted(SIZE, (84, 70, 56)) * (1 + 0.2 * fractal(SIZE, 1.5, rng))[..., None]
    return texture(painted + 12 * speckle(SIZE, 1.2, rng)[..., None])
