"""Expose the rows of a picture one after the other while the camera moves.

The model is of first order in the readout time. Row v shows the point of each pixel where it was at
the row's own time, given its depth and the camera's velocity and turn rate at mid-frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.frame import LinearFrame, sampled

SKY_M = 1e6


@dataclass(frozen=True)
class RollingShutter:
    """The time from the first row to the last."""

    readout_s: Annotated[float, Range(0, 0.1)] = 0.02

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Move every pixel by what the camera does between mid-frame and its row."""
        k = frame.camera.intrinsics
        u, v = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
        late_s = self.readout_s * (v / k.height_px - 0.5)
        x, y = (u - k.cx_px) / k.fx_px, (v - k.cy_px) / k.fy_px
        z = np.minimum(frame.depth_m, SKY_M).astype(np.float64)
        (vx, vy, vz), (wx, wy, wz) = frame.velocity_mps, frame.turn_radps
        mid_x = x * z + late_s * (vx + wy * z - wz * y * z)
        mid_y = y * z + late_s * (vy + wz * x * z - wx * z)
        mid_z = np.maximum(z + late_s * (vz + wx * y * z - wy * x * z), 1e-3)
        u_px = (k.fx_px * mid_x / mid_z + k.cx_px).astype(np.float32)
        v_px = (k.fy_px * mid_y / mid_z + k.cy_px).astype(np.float32)
        return replace(frame, colour=sampled(frame.colour, u_px, v_px))
