"""Absorb light over distance and add the colour of the air instead (Koschmieder's law).

The haze is a level layer of height ``layer_m``. A ray at elevation e leaves it after
``layer_m / sin(e)``, so that the zenith stays partly visible and the horizon does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.lens import LensCamera
from rfcore.tables import Range
from streetgen.frame import F32, LinearFrame

LEAST_UP = 1e-4


@dataclass(frozen=True)
class Haze:
    """The haze's density, height and colour.

    A black object at ``visibility_m`` keeps 5 % contrast (the meteorological range). ``layer_m`` is
    the height of the haze, ``air`` its own linear light.
    """

    visibility_m: Annotated[float, Range(10, 100_000)] = 800.0
    layer_m: Annotated[float, Range(1, 10_000)] = 150.0
    air: Annotated[float, Range(0, 2)] = 0.55

    def apply(self, frame: LinearFrame, _rng: np.random.Generator) -> LinearFrame:
        """Mix each pixel with the air by how much of it lies before what one sees."""
        extinction = np.log(np.float32(20.0)) / np.float32(self.visibility_m)
        length, up = _rays(frame.camera)
        through_m = np.minimum(frame.depth_m * length, self.layer_m / np.maximum(up, LEAST_UP))
        kept = np.exp(-extinction * through_m)[..., None]
        colour = frame.colour * kept + np.float32(self.air) * (1 - kept)
        return replace(frame, colour=colour.astype(np.float32))


def _rays(camera: Camera | LensCamera) -> tuple[F32, NDArray[np.float64]]:
    """Return the length of the pixels' rays at z = 1, and the sine of their elevation."""
    k = camera.intrinsics
    x = (np.arange(k.width_px) + 0.5 - k.cx_px) / k.fx_px
    y = ((np.arange(k.height_px) + 0.5 - k.cy_px) / k.fy_px)[:, None]
    length = np.sqrt(x * x + y * y + 1)
    right, down, forward = camera.world_from_cam.rotation_matrix()[2]
    return length.astype(np.float32), (right * x + down * y + forward) / length
