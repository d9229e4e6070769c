"""What is seen from a camera: rendered views, posed pictures, and points of the scene.

Readers produce posed pictures, trainers consume them; renderers produce views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.confidence import confidence
from rfcore.errors import InvalidInput

__all__ = ["PointCloud", "PosedPicture", "View"]


@dataclass(frozen=True)
class View:
    """A rendered view of a radiance field.

    ``colour`` float32 [H, W, 3], display-referred RGB, nominally 0..1 (not clamped);
    ``depth`` float32 [H, W], alpha-weighted mean z in metres, 0 where nothing was hit;
    ``opacity`` float32 [H, W], 1 - final transmittance; ``confidence`` float32 [H, W], 0..1, how
    far the renderer itself trusts a pixel (``rfcore.confidence``), computed when first asked for.
    """

    colour: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """Opacity, less where depth breaks."""
        return confidence(self.depth, self.opacity)


@dataclass(frozen=True)
class PosedPicture:
    """A picture with the camera that took it; pixels are read only when asked for.

    ``read`` returns uint8 [H, W, 3] RGB of exactly the camera's size.
    """

    name: str
    camera: Camera
    read: Callable[[], NDArray[np.uint8]]
    time_ns: int = 0


@dataclass(frozen=True)
class PointCloud:
    """Surface points with colour: ``xyz_m`` float32 [N, 3] tile-relative, ``rgb`` uint8 [N, 3]."""

    xyz_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def __post_init__(self) -> None:
        n = len(self.xyz_m)
        if self.xyz_m.shape != (n, 3) or self.rgb.shape != (n, 3):
            raise InvalidInput(
                "points",
                f"shapes {self.xyz_m.shape} and {self.rgb.shape} must both be [N, 3]",
            )
        if not np.isfinite(self.xyz_m).all():
            bad = int((~np.isfinite(self.xyz_m)).any(axis=1).sum())
            raise InvalidInput("points.xyz_m", f"{bad} of {n} points are not finite")
