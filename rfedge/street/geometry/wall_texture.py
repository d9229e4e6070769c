"""Walls: bricks in running bond, rendered plaster with streaks of rain, cut stone, roof tiles."""

from __future__ import annotations

import cv2
import numpy as np

from rfedge.street.geometry.grain import enlarged, fractal, texture, tinted
from rfedge.street.geometry.material import Colour, Texture
from rfedge.street.geometry.mesh import F32

__all__ = ["WALL_TILE_M", "bricks", "plaster", "roof_tiles", "stone"]

WALL_TILE_M = 4.0
SHAPE = (1024, 1024)
"""256 px a metre: a brick is 64 by 16 px, 25 by 6.2 cm."""
BRICK_PX, COURSE_PX = 64, 16


def bricks(light: Colour, dark: Colour, mortar: Colour, rng: np.random.Generator) -> Texture:
    """Return a brick wall whose bricks are between two colours."""
    painted = tinted(SHAPE, mortar) * (1 + 0.08 * fractal(SHAPE, 2.6, rng)[..., None])
    for course in range(SHAPE[0] // COURSE_PX):
        shift_px = (course % 2) * BRICK_PX // 2
        rows = slice(course * COURSE_PX + 2, (course + 1) * COURSE_PX - 2)
        for i in range(SHAPE[1] // BRICK_PX):
            share, shade = rng.uniform((0, 0.8), (1, 1.15))
            colour = (np.array(light) + (np.array(dark) - np.array(light)) * share) * shade
            start = i * BRICK_PX + shift_px
            painted[rows, np.arange(start + 2, start + BRICK_PX - 2) % SHAPE[1]] = colour
    painted *= 1 + 0.09 * fractal(SHAPE, 2.4, rng)[..., None]
    painted *= 1 + 0.07 * rng.standard_normal((*SHAPE, 1), dtype=np.float32)
    return texture(painted)


def plaster(colour: Colour, rng: np.random.Generator) -> Texture:
    """Return rendered plaster, streaked by rain and cracked in places."""
    return texture(_plaster(colour, rng))


def stone(colour: Colour, rng: np.random.Generator) -> Texture:
    """Return ashlar: blocks of 1 by 0.5 m in running bond."""
    painted = _plaster(colour, rng)
    for course in range(8):
        top = course * 128
        painted[top : top + 5] *= 0.6
        for start in range(0, 1024, 256):
            left = (start + (course % 2) * 128) % 1024
            painted[top : top + 128, left : left + 5] *= 0.6
    return texture(painted)


def roof_tiles(rng: np.random.Generator) -> Texture:
    """Return courses of clay tiles."""
    painted = tinted((512, 512), (120, 60, 46))
    painted *= 1 + 0.1 * fractal((512, 512), 2.2, rng)[..., None]
    for course in range(0, 512, 32):
        painted[course : course + 4] *= 0.5
    return texture(painted)


def _plaster(colour: Colour, rng: np.random.Generator) -> F32:
    painted = tinted(SHAPE, colour) * (1 + 0.05 * fractal(SHAPE, 2.6, rng)[..., None])
    painted *= 1 + 0.035 * rng.standard_normal((*SHAPE, 1), dtype=np.float32)
    streaks = enlarged(rng.standard_normal((4, 256), dtype=np.float32), SHAPE)
    soiled = np.clip(fractal(SHAPE, 3.0, rng), 0, 2)
    painted *= 1 - 0.04 * (soiled * (1 + np.clip(streaks, -1, 2)))[..., None]
    dark = tuple(0.65 * value for value in colour)
    for _ in range(10):
        steps = rng.normal(0, 9, (30, 2)) + np.array([3, 5])
        line = (rng.uniform(0, 1024, 2) + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(painted, [line], False, dark, 1, cv2.LINE_AA)
    return painted
