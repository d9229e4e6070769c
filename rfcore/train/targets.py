"""The pictures a field is trained on, held in memory as 8-bit pixels."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.views import PosedPicture

__all__ = ["Target", "load_targets"]


@dataclass(frozen=True)
class Target:
    """A camera and what it saw: ``rgb`` uint8 [H, W, 3]."""

    camera: Camera
    rgb: Rgb

    def colour(self) -> NDArray[np.float32]:
        """Return the picture as float32 [H, W, 3] in 0..1."""
        return self.rgb.astype(np.float32) / np.float32(255.0)


def load_targets(pictures: Sequence[PosedPicture]) -> tuple[tuple[Target, ...], str]:
    """Read every picture; return them with the SHA-256, in hex, of their cameras and pixels."""
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to train a field")
    targets = tuple(Target(picture.camera, picture.read()) for picture in pictures)
    digest = hashlib.sha256()
    for target in targets:
        digest.update(repr(target.camera).encode())
        digest.update(np.ascontiguousarray(target.rgb).data)
    return targets, digest.hexdigest()
