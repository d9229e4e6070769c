"""What one walks and drives on: asphalt with cracks and patches, paving slabs, worn paint."""

from __future__ import annotations

import cv2
import numpy as np

from rfedge.street.geometry.grain import fractal, speckle, texture, tinted
from rfedge.street.geometry.material import Texture
from rfedge.street.geometry.mesh import F32

__all__ = ["ASPHALT_TILE_M", "SLAB_TILE_M", "asphalt", "paint", "slabs"]

ASPHALT_TILE_M = 8.0
SLAB_TILE_M = 4.0
CRACKS, PATCHES, STAINS = 14, 9, 40


def asphalt(rng: np.random.Generator) -> Texture:
    """Return 8 m by 8 m of road at 256 px a metre."""
    shape = (2048, 2048)
    painted = tinted(shape, (78, 78, 80))
    painted *= 1 + 0.06 * fractal(shape, 2.6, rng)[..., None]
    painted += 11 * speckle(shape, 1.2, rng)[..., None] + 4 * fractal(shape, 1.2, rng)[..., None]
    for _ in range(CRACKS):
        width_px = int(rng.integers(1, 4))
        line = _wander(rng, 2048, steps=60, step_px=14.0)
        cv2.polylines(painted, [line], False, (38, 38, 38), width_px, cv2.LINE_AA)
    for _ in range(PATCHES):
        _patch(painted, rng)
    for _ in range(STAINS):
        middle = tuple(int(v) for v in rng.integers(0, 2048, 2))
        axes = (int(rng.integers(4, 40)), int(rng.integers(4, 26)))
        grey = (rng.uniform(48, 72),) * 3
        cv2.ellipse(painted, middle, axes, rng.uniform(0, 180), 0, 360, grey, -1, cv2.LINE_AA)
    return texture(painted)


def slabs(rng: np.random.Generator) -> Texture:
    """Return 4 m by 4 m of pavement, slabs of half a metre, at 256 px a metre."""
    shape, side = (1024, 1024), 128
    painted = tinted(shape, (140, 136, 128))
    painted *= 1 + 0.07 * fractal(shape, 2.6, rng)[..., None]
    painted *= 1 + 0.05 * rng.standard_normal((*shape, 1), dtype=np.float32)
    shades = rng.uniform(0.84, 1.12, (8, 8)).astype(np.float32)
    painted *= shades.repeat(side, axis=0).repeat(side, axis=1)[..., None]
    for joint in range(0, 1024, side):
        painted[joint : joint + 4] *= 0.5
        painted[:, joint : joint + 4] *= 0.5
    for _ in range(220):
        middle = tuple(int(v) for v in rng.integers(0, 1024, 2))
        grey = (rng.uniform(70, 110),) * 3
        cv2.circle(painted, middle, int(rng.integers(2, 6)), grey, -1, cv2.LINE_AA)
    return texture(painted)


def paint(rng: np.random.Generator) -> Texture:
    """Return road paint that traffic has worn through in places, 2 m by 2 m."""
    shape = (512, 512)
    painted = tinted(shape, (215, 215, 208)) * (1 + 0.06 * fractal(shape, 2.6, rng)[..., None])
    worn = fractal(shape, 1.8, rng) + 0.5 * rng.standard_normal(shape, dtype=np.float32)
    painted[worn > 1.5] = (90, 90, 92)
    return texture(painted)


def _patch(painted: F32, rng: np.random.Generator) -> None:
    x, y = (int(v) for v in rng.integers(0, 1540, 2))
    width, height = (int(v) for v in rng.integers(120, 500, 2))
    painted[y : y + height, x : x + width] *= rng.uniform(0.72, 1.12)
    cv2.rectangle(painted, (x, y), (x + width, y + height), (42, 42, 42), 3)


def _wander(rng: np.random.Generator, side_px: int, steps: int, step_px: float) -> np.ndarray:
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, steps))
    moves = step_px * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.asarray(rng.uniform(0, side_px, 2) + np.cumsum(moves, axis=0)).astype(np.int32)
