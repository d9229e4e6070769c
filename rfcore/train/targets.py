"""The pictures a field is trained on: their pixels, random rays, and numbers learnt for each.

Pictures are held in memory as 8-bit pixels. The n-th batch of rays of a seed is always the same, so
a checkpoint need not store it; rays are computed in float64 with elementwise operations only (no
BLAS), then rounded once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics
from rfcore.errors import InvalidInput
from rfcore.image import Rgb
from rfcore.ngp.trainable import RayBatch
from rfcore.raster.trainable import Exposure
from rfcore.views import Mask, PosedPicture

F64 = NDArray[np.float64]
EXPOSURE_RATE = 3e-3
"""Adam's rate at the start of the run: it learns a stop of exposure within some hundred visits."""
EXPOSURE_EPSILON = 1e-12
BETA1, BETA2 = 0.9, 0.99
"""Adam's constants for a picture: its second moment is that of its last hundred visits."""
NO_CHANGE = np.eye(3, 4)


@dataclass(frozen=True)
class Target:
    """A camera and what it saw: ``rgb`` uint8 [H, W, 3].

    ``mask`` bool [H, W] says which pixels are learnt; ``None`` stands for all of them.
    """

    camera: Camera
    rgb: Rgb
    mask: Mask | None = field(default=None, kw_only=True)

    def colour(self) -> NDArray[np.float32]:
        """Return the picture as float32 [H, W, 3] in 0..1."""
        return self.rgb.astype(np.float32) / np.float32(255.0)

    def colour_beside(self, shown: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return ``colour``, outside the mask that of ``shown``, where nothing is to be learnt."""
        colour = self.colour()
        return colour if self.mask is None else np.where(self.mask[..., None], colour, shown)


def load_targets(pictures: Sequence[PosedPicture]) -> tuple[tuple[Target, ...], str]:
    """Read every picture; return them with the SHA-256, in hex, of their cameras and pixels."""
    if not pictures:
        raise InvalidInput("pictures", "at least one is needed to train a field")
    targets = tuple(Target(p.camera, p.read(), mask=p.read_mask()) for p in pictures)
    if not any(target.mask is None or target.mask.any() for target in targets):
        raise InvalidInput("pictures", "their masks leave no pixel to learn")
    digest = hashlib.sha256()
    for target in targets:
        digest.update(repr(target.camera).encode())
        digest.update(np.ascontiguousarray(target.rgb).data)
        if target.mask is not None:
            digest.update(np.packbits(target.mask).data)
    return targets, digest.hexdigest()


def halved(target: Target) -> Target:
    """Return a picture of half the size: means of 2x2 pixels, rounded to nearest, a half up.

    A pixel is learnt if all four are. The last row or column of an odd number is left out. Raises
    ``InvalidInput`` for a picture of one row or column.
    """
    k = target.camera.intrinsics
    width, height = k.width_px // 2, k.height_px // 2
    if not width or not height:
        raise InvalidInput("picture", f"{k.width_px}x{k.height_px} px cannot be halved")
    intrinsics = Intrinsics(width, height, k.fx_px / 2, k.fy_px / 2, k.cx_px / 2, k.cy_px / 2)
    quads = target.rgb[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
    rgb = ((quads.sum(axis=(1, 3), dtype=np.uint16) + 2) // 4).astype(np.uint8)
    mask = None
    if target.mask is not None:
        cut = target.mask[: 2 * height, : 2 * width]
        mask = np.asarray(cut.reshape(height, 2, width, 2).all(axis=(1, 3)))
    return Target(
        replace(target.camera, intrinsics=intrinsics), np.ascontiguousarray(rgb), mask=mask
    )


class RaySampler:
    """Draws pixels of ``targets`` uniformly, those that their masks leave."""

    def __init__(self, targets: Sequence[Target], seed: int) -> None:
        self._seed = seed
        self._pixels = np.concatenate([target.rgb.reshape(-1, 3) for target in targets])
        sizes = [target.rgb.shape[0] * target.rgb.shape[1] for target in targets]
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._drawn = _drawn_pixels(targets)
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
        if self._drawn is None:
            pixel = rng.integers(0, len(self._pixels), count)
        else:
            pixel = self._drawn[rng.integers(0, len(self._drawn), count)]
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


def _drawn_pixels(targets: Sequence[Target]) -> NDArray[np.int64] | None:
    """Return the numbers of the pixels that are drawn, ``None`` for all of them."""
    if all(target.mask is None for target in targets):
        return None
    masks = [
        np.ones(target.rgb.shape[:2], bool) if target.mask is None else target.mask
        for target in targets
    ]
    return np.flatnonzero(np.concatenate([mask.ravel() for mask in masks]))


class PictureAdam:
    """Adam on one set of numbers a picture, which moves when the picture is visited.

    ``values`` [V, ...]: the numbers of V pictures. ``name`` prefixes the arrays of a checkpoint.
    """

    def __init__(self, name: str, values: F64, epsilon: float) -> None:
        self.values = values
        self._name, self._epsilon = name, epsilon
        self._first, self._second = np.zeros_like(values), np.zeros_like(values)
        self._visits = np.zeros(len(values))

    def step(self, view: int, gradient: F64, rate: float | F64) -> None:
        """Visit a picture: move its numbers by ``rate``, down this gradient."""
        self._visits[view] += 1
        first, second = self._first[view], self._second[view]
        first += (1 - BETA1) * (gradient - first)
        second += (1 - BETA2) * (gradient * gradient - second)
        # Multiplied out: two C libraries' pow() need not agree.
        powers = np.multiply.reduce(np.tile([BETA1, BETA2], (int(self._visits[view]), 1)))
        mean, square = first / (1 - powers[0]), second / (1 - powers[1])
        self.values[view] -= rate * mean / (np.sqrt(square) + self._epsilon)

    def arrays(self) -> dict[str, F64]:
        """Return copies of everything that ``restore`` goes on from."""
        parts = {
            "values": self.values,
            "first": self._first,
            "second": self._second,
            "visits": self._visits,
        }
        return {f"{self._name}.{part}": array.copy() for part, array in parts.items()}

    def restore(self, arrays: Mapping[str, F64]) -> None:
        """Go on from ``arrays``."""
        parts = ("values", "first", "second", "visits")
        copies = (arrays[f"{self._name}.{part}"].copy() for part in parts)
        self.values, self._first, self._second, self._visits = copies


class ExposureModel:
    """Exposure of each picture: an affine map of colours [3, 4], learned with the field.

    The maps' mean over the pictures is kept at "no change", so the field itself shows the mean
    picture and is rendered without any map.
    """

    def __init__(self, views: int) -> None:
        self.adam = PictureAdam("exposure", np.tile(NO_CHANGE, (views, 1, 1)), EXPOSURE_EPSILON)

    def of_view(self, view: int) -> Exposure:
        """Return the map of a picture, with room for its gradient."""
        maps = self.adam.values
        affine = maps[view] - maps.mean(axis=0) + NO_CHANGE
        return Exposure(np.ascontiguousarray(affine, np.float32), np.zeros((3, 4)))

    def step(self, view: int, gradient: F64, factor: float) -> None:
        """Do one step of Adam at ``factor`` times the rate."""
        self.adam.step(view, gradient, EXPOSURE_RATE * factor)
