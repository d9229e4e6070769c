"""The pictures a field is trained on, held in memory as 8-bit pixels.

Random pixels of the training pictures as rays with their colours.

The n-th batch of a seed is always the same: a run that goes on from a checkpoint needs no state.
Rays are computed in float64 with elementwise operations only (no BLAS), then rounded once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.ngp.trainable import RayBatch
from rfcore.views import PosedPicture

__all__ = ["RaySampler", "Target", "load_targets"]


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


class RaySampler:
    """Draws pixels of ``targets``, every one as likely as any other."""

    def __init__(self, targets: Sequence[Target], seed: int) -> None:
        self._seed = seed
        self._pixels = np.concatenate([target.rgb.reshape(-1, 3) for target in targets])
        sizes = [target.rgb.shape[0] * target.rgb.shape[1] for target in targets]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        intrinsics = [target.camera.intrinsics for target in targets]
        self._widths = np.array([k.width_px for k in intrinsics])
        self._focal = np.array([(k.fx_px, k.fy_px) for k in intrinsics])
        self._centre = np.array([(k.cx_px, k.cy_px) for k in intrinsics])
        poses = [target.camera.world_from_cam for target in targets]
        self._rotation = np.array([pose.rotation_matrix() for pose in poses])
        self._position = np.array([pose.translation_m for pose in poses], dtype=np.float32)

    def batch(self, number: int, rays_per_block: int, blocks: int, most_samples: int) -> RayBatch:
        """Return batch ``number`` of ``blocks`` blocks of ``rays_per_block`` rays."""
        rng = np.random.default_rng((self._seed, number))
        count = rays_per_block * blocks
        pixel = rng.integers(0, len(self._pixels), count)
        view = np.searchsorted(self._starts, pixel, side="right") - 1
        return RayBatch(
            origins=self._position[view],
            directions=self._directions(view, pixel - self._starts[view]),
            jitter=rng.random(count, dtype=np.float32),
            targets=self._pixels[pixel].astype(np.float32) / np.float32(255),
            rays_per_block=rays_per_block,
            samples_per_ray=most_samples,
        )

    def _directions(self, view: NDArray[np.int64], pixel: NDArray[np.int64]) -> NDArray[np.float32]:
        width = self._widths[view]
        x = (pixel % width + 0.5 - self._centre[view, 0]) / self._focal[view, 0]
        y = (pixel // width + 0.5 - self._centre[view, 1]) / self._focal[view, 1]
        length = np.sqrt(x * x + y * y + 1)
        m = self._rotation[view]
        turned = m[:, :, 0] * x[:, None] + m[:, :, 1] * y[:, None] + m[:, :, 2]
        return np.ascontiguousarray(turned / length[:, None], dtype=np.float32)
