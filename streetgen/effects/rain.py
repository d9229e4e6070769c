"""Draw streaks of falling drops, as long as the drops fall while the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.frame import F32, LinearFrame

FALL_MPS = 9.0
"""Terminal velocity of drops of 5 mm (Gunn and Kinzer 1949)."""
DROP_WIDTH_M = 0.0025
NEAR_M, FAR_M = 1.5, 25.0
OPACITY = 0.9
"""Opacity of a streak that is as wide as a pixel. A drop covers each place for a part of the
shutter's time, and is brighter than its surroundings, because it gathers the sky.
"""


@dataclass(frozen=True)
class Rain:
    """The number of drops in the picture, the shutter's time, wind to the right, and brightness."""

    drops: Annotated[int, Range(0, 100_000)] = 900
    shutter_s: Annotated[float, Range(0.0001, 0.1)] = 0.01
    wind_mps: Annotated[float, Range(-20, 20)] = 0.5
    brightness: Annotated[float, Range(0, 2)] = 0.6

    def apply(self, frame: LinearFrame, rng: np.random.Generator) -> LinearFrame:
        """Draw the drops over the frame; they add up, so their order does not matter.

        The number of drops at a distance grows with its square, as the visible volume does.
        """
        height, width = frame.depth_m.shape
        cover = np.zeros((height, width), np.float32)
        focal_px = frame.camera.intrinsics.fy_px
        x, y = rng.uniform(0, width, self.drops), rng.uniform(0, height, self.drops)
        far_m = np.cbrt(rng.uniform(NEAR_M**3, FAR_M**3, self.drops))
        for u, v, z in zip(x, y, far_m, strict=True):
            self._draw(cover, frame.depth_m, (u, v, z), focal_px)
        share = np.minimum(cover, 0.6)[..., None]
        colour = frame.colour * (1 - share) + np.float32(self.brightness) * share
        return replace(frame, colour=colour.astype(np.float32))

    def _draw(
        self, cover: F32, depth_m: F32, drop: tuple[float, float, float], focal_px: float
    ) -> None:
        """Add a streak, each row of it shared by two columns, fading at both ends."""
        u, v, z = drop
        length_px = max(FALL_MPS * self.shutter_s * focal_px / z, 1.0)
        rows = np.arange(int(v), min(int(v + length_px) + 1, cover.shape[0]))
        ends = np.sin(np.pi * (rows - int(v) + 0.5) / (int(length_px) + 1))
        opacity = OPACITY * min(DROP_WIDTH_M * focal_px / z, 1.0) * np.clip(ends, 0, 1)
        place = u + self.wind_mps / FALL_MPS * (rows - v) - 0.5
        left = np.floor(place).astype(int)
        for columns, share in ((left, 1 - (place - left)), (left + 1, place - left)):
            inside = (columns >= 0) & (columns < cover.shape[1])
            at = rows[inside], columns[inside]
            drawn = np.where(depth_m[at] > z, opacity[inside] * share[inside], 0.0)
            np.add.at(cover, at, drawn.astype(np.float32))
