"""What a caller asks of every frame beside its quality: a quantiser map.

``SteeringSettings`` is its form on a command line, where the map is the file of a mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rfcore.codec.h264.qp_map import QpMap, qp_map_of_mask
from rfcore.errors import InvalidInput
from rfcore.image import read_rgb

__all__ = ["NO_STEERING", "Steering", "SteeringSettings"]

BRIGHT = 128
"""The level from which a pixel of a mask's file belongs to it, in any channel."""


@dataclass(frozen=True)
class Steering:
    """What is asked of every frame."""

    qp_map: QpMap | None = None
    """Where frames are coded finer or coarser."""


NO_STEERING = Steering()


@dataclass(frozen=True)
class SteeringSettings:
    """Where bits go."""

    mask: Path | None = None
    """Picture of the camera's size, white where frames are to be coded finer."""
    mask_qp: int = -6
    """Added to H.264's quantiser in the mask, -24..24; -6 halves its step."""

    def steering(self, size_px: tuple[int, int]) -> Steering:
        """Return it for frames of ``size_px``; raises for a mask that is not of that size."""
        if self.mask is None:
            return NO_STEERING
        bright = read_rgb(self.mask).max(axis=2) >= BRIGHT
        if bright.shape != size_px[::-1]:
            raise InvalidInput(
                "mask",
                f"{self.mask} has {bright.shape[1]}x{bright.shape[0]} px, the camera "
                f"{size_px[0]}x{size_px[1]} px",
            )
        return Steering(qp_map_of_mask(bright, size_px, self.mask_qp))
