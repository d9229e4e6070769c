"""Rain: drops nearer than what is behind them, drawn as streaks as long as they fall in a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfedge.street.frame import F32, LinearFrame
from rfedge.street.schema import Range

__all__ = ["Rain"]

FALL_MPS = 9.0
"""Terminal velocity of drops of 5 mm (Gunn and Kinzer 1949)."""
DROP_WIDTH_M = 0.004
NEAR_M, FAR_M = 2.0, 25.0


@dataclass(frozen=True)
class Rain:
    """``drops`` in the picture, seen for ``shutter_s``, blown by ``wind_mps`` to the right."""

    drops: Annotated[int, Range(0, 100_000)] = 900
    shutter_s: Annotated[float, Range(0.0001, 0.1)] = 0.01
    wind_mps: Annotated[float, Range(-20, 20)] = 0.5
    brightness: Annotated[float, Range(0, 2)] = 0.6

    def apply(self, frame: LinearFrame, rng: np.random.Generator) -> LinearFrame:
        """Draw the drops over the frame; farther ones first does not matter, they add up."""
        height, width = frame.depth_m.shape
        cover = np.zeros((height, width), np.float32)
        focal_px = frame.camera.intrinsics.fy_px
        x, y = rng.uniform(0, width, self.drops), rng.uniform(0, height, self.drops)
        for u, v, z in zip(x, y, rng.uniform(NEAR_M, FAR_M, self.drops), strict=True):
            self._draw(cover, frame.depth_m, (u, v, z), focal_px)
        share = np.minimum(cover, 0.6)[..., None]
        colour = frame.colour * (1 - share) + np.float32(self.brightness) * share
        return replace(frame, colour=colour.astype(np.float32))

    def _draw(
        self, cover: F32, depth_m: F32, drop: tuple[float, float, float], focal_px: float
    ) -> None:
        u, v, z = drop
        length_px = max(FALL_MPS * self.shutter_s * focal_px / z, 1.0)
        slant = self.wind_mps / FALL_MPS
        rows = np.arange(int(v), min(int(v + length_px) + 1, cover.shape[0]))
        columns = (u + slant * (rows - v)).astype(int)
        inside = (columns >= 0) & (columns < cover.shape[1])
        rows, columns = rows[inside], columns[inside]
        seen = depth_m[rows, columns] > z
        opacity = min(DROP_WIDTH_M * focal_px / z, 1.0) * min(10.0 / length_px, 1.0)
        np.add.at(cover, (rows[seen], columns[seen]), np.float32(opacity))
