"""Fits a colour layer to passes: another light on the field's shape.

Voxels are fitted first, coarse to fine, then single splats, because reducing a finished fit to
fewer numbers ruins it. A frame's error is distributed to splats by their blending weights. The
backward pass of a grey field computes these, so that black splats are treated like any other. Each
round is a weighted least squares for every voxel at once (SIRT, Gilbert 1972), for single splats
with Nesterov's momentum.

Where two passes disagree the layer would be their mean, so pixels that the others contradict are
left out (``rfcore.update.passes``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field import SplatField
from rfcore.field.layer import (
    MIDDLE_LUMA,
    OFFSET_STEP,
    OWN_STEP,
    SLOPE_STEP,
    VOXELS_M,
    ColourLayer,
    layer_archive,
    layered_colours,
    layered_field,
    luma_of,
    rgb_of,
    voxels_of,
)
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import Gaussians
from rfcore.raster.native import Rasterizer
from rfcore.raster.trainable import TrainableRasterizer
from rfcore.update.passes import SeenFrame, trusted_pixels
from rfcore.update.splats import Progress

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
FINEST_VOXELS, OTHER_VOXELS = (16.0, 3), (0.25, 1)
"""The weight in pixels above which a voxel gets a colour, and its step in units of the format's.
The finest voxels take most bytes: from 0.25 pixels on and in single steps the voxels of the
benchmark street take 141 kB at dusk, from 4 pixels on and in triple steps 88 kB for 0.1 dB less."""
OWN_WEIGHTS = (4.0, 16.0, 64.0)
"""Weights of single splats in pixels. Below the first a splat gets no colour of its own; above
these it is coded in 4, 2 and 1 times ``OWN_COARSER`` steps of the format."""
OWN_COARSER = 2
DEAD_ZONE = 0.1
"""Values are rounded towards 0: a step is taken from 0.5 plus this on."""
ALL_BANDS = 64
BANDS = 32
"""Higher bands of the colour are halved: the squared error of the benchmark street at dusk is then
1.6 % below that with full bands and 2.4 % below that without bands."""
OUTLINE_ROUNDS = 2
SLOPE_RIDGE = 0.075
"""Ridge on slopes as a share of that on offsets, since variances of luma are small."""


@dataclass(frozen=True)
class ColourFit:
    """Settings of the fit of a layer. ``threads`` changes only the time it takes."""

    voxel_rounds: int = 8
    own_rounds: int = 12
    ridge: float = 8.0
    """Weight of no change for a voxel, in pixels."""
    own_ridge: float = 1.0
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("voxel_rounds", "own_rounds"):
            if not 1 <= getattr(self, name) <= 1000:
                raise InvalidInput(f"colours.{name}", f"{getattr(self, name)} is outside 1..1000")


def colour_layer(
    base: SplatField,
    frames: Sequence[SeenFrame],
    config: ColourFit,
    progress: Progress | None = None,
) -> SplatField:
    """Return ``base`` with the layer that brings it nearest to ``frames``.

    Raises ``InvalidInput`` without frames or splats.
    """
    if not frames or not base.primitives:
        raise InvalidInput("update", f"{len(frames)} frames, {base.primitives} splats: not enough")
    fit = _Fit(base, frames, config, progress)
    if len({frame.pass_number for frame in frames}) == 1:
        return _field(base, fit.layer())
    fit.trust(base)
    fit.trust(_field(base, fit.outline()))
    return _field(base, fit.layer())


def _field(base: SplatField, layer: ColourLayer) -> SplatField:
    metadata = replace(base.metadata, training_digest="", held_out_psnr_db=None, held_out_ssim=None)
    return layered_field(layer_archive(layer, base, metadata), base, metadata)


class _Fit:
    """The state of a fit: frames, voxels, weights."""

    def __init__(
        self,
        base: SplatField,
        frames: Sequence[SeenFrame],
        config: ColourFit,
        progress: Progress | None,
    ) -> None:
        self._base, self._frames, self._config = base, frames, config
        self._progress, self._rounds = progress, 0
        self._cameras = [frame.camera for frame in frames]
        self._targets = [frame.colour() for frame in frames]
        self._trusted: list[F32] = [np.ones(t.shape[:2], np.float32) for t in self._targets]
        self._grey = TrainableRasterizer(
            _grey(base.gaussians), threads=config.threads, antialiased=base.metadata.antialiased
        )
        self._slope_of = luma_of(base.gaussians) - MIDDLE_LUMA
        self._voxels = [voxels_of(base.gaussians.means, side_m) for side_m in VOXELS_M]
        self._voxel_numbers = [np.zeros((count, 6)) for _, count in self._voxels]
        self._weights = self._gathered_weights()

    def trust(self, field: SplatField) -> None:
        """Exclude from now on pixels that only single passes show, compared with ``field``."""
        for number, trusted in enumerate(trusted_pixels(field, self._frames)):
            if trusted is not None:
                self._trusted[number] *= trusted
        self._weights = self._gathered_weights()

    def layer(self) -> ColourLayer:
        """Return the layer fitted to the trusted pixels."""
        voxels = self._with_voxels(self._voxel_numbers, self._config.voxel_rounds)
        nothing = np.zeros((self._base.primitives, 3), np.int32)
        start = ColourLayer(self._quantised_voxels(voxels), nothing, BANDS)
        return replace(start, own=self._quantised_own(self._own(start)))

    def outline(self) -> ColourLayer:
        """Return a layer of voxels only, from which ``layer`` then continues."""
        self._voxel_numbers = self._with_voxels(self._voxel_numbers, OUTLINE_ROUNDS)
        nothing = np.zeros((self._base.primitives, 3), np.int32)
        return ColourLayer(self._quantised_voxels(self._voxel_numbers), nothing, BANDS)

    def _with_voxels(self, voxels: Sequence[F64], rounds: int) -> list[F64]:
        """Return the coefficients [V, 6] for every size of voxel after so many more rounds."""
        base = self._base.gaussians
        voxels = [part.copy() for part in voxels]
        for _ in range(rounds):
            change = np.zeros((len(base), 3))
            for (voxel, _), part in zip(self._voxels, voxels, strict=True):
                change += part[voxel, :3] + part[voxel, 3:] * self._slope_of[:, None]
            self._solve(_ycc(self._gathered(_coloured(base, rgb_of(change), BANDS))), voxels)
        return voxels

    def _solve(self, left: F64, voxels: Sequence[F64]) -> None:
        """Add to every voxel, coarse to fine, the least squares solution for ``left`` [N, 3]."""
        weights, slope_of, ridge = self._weights, self._slope_of, self._config.ridge
        for (voxel, count), part in reversed(list(zip(self._voxels, voxels, strict=True))):
            weight = np.bincount(voxel, weights, count)
            mean = np.bincount(voxel, weights * slope_of, count) / np.maximum(weight, 1e-6)
            centred = slope_of - mean[voxel]
            variance = np.bincount(voxel, weights * centred * centred, count)
            for channel in range(3):
                column = left[:, channel]
                offset = np.bincount(voxel, column, count) / (weight + ridge)
                moment = np.bincount(voxel, column * centred, count)
                slope = np.clip(moment / (variance + ridge * SLOPE_RIDGE), -1, 1)
                part[:, channel] += offset - slope * mean
                part[:, 3 + channel] += slope
                left[:, channel] -= weights * (offset[voxel] + slope[voxel] * centred)

    def _quantised_voxels(self, voxels: Sequence[F64]) -> tuple[NDArray[np.int32], ...]:
        steps = np.array([*OFFSET_STEP, *SLOPE_STEP])
        out = []
        for level, ((voxel, count), part) in enumerate(zip(self._voxels, voxels, strict=True)):
            least, coarser = FINEST_VOXELS if level == 0 else OTHER_VOXELS
            seen = np.bincount(voxel, self._weights, count) > least
            whole = _whole(part / (steps * coarser)) * coarser
            out.append(np.where(seen[:, None], whole, 0).astype(np.int32))
        return tuple(out)

    def _own(self, start: ColourLayer) -> F64:
        """Return the colours that single splats add to ``start`` [N, 3], in red, green, blue."""
        lit = layered_colours(self._base.gaussians, start)
        own = np.zeros((len(lit), 3))
        before, momentum, ridge = own.copy(), 1.0, self._config.own_ridge
        weights = (self._weights + ridge)[:, None]
        black = -0.5 - lit.sh[:, 0].astype(np.float64) * SH_DC
        for _ in range(self._config.own_rounds):
            sums = self._gathered(_coloured(lit, own, ALL_BANDS))
            now = np.maximum(own + (sums - ridge * own) / weights, np.minimum(black, 0.0))
            faster = (1 + math.sqrt(1 + 4 * momentum * momentum)) / 2
            own = now + (momentum - 1) / faster * (now - before)
            before, momentum = now, faster
        return before

    def _quantised_own(self, own: F64) -> NDArray[np.int32]:
        """Return integers, in coarser steps for splats that are hardly seen."""
        least, some, much = OWN_WEIGHTS
        weights = self._weights
        scale = np.where(weights > much, 1.0, np.where(weights > some, 2.0, 4.0))[:, None]
        scale = scale * OWN_COARSER
        whole = _whole(_ycc(own) / (OWN_STEP * scale)) * scale
        return np.where(weights[:, None] > least, np.clip(whole, -127, 127), 0).astype(np.int32)

    def _gathered(self, gaussians: Gaussians) -> F64:
        """Return the frames' errors distributed to splats [N, 3]."""
        self._tell()
        rasterizer = Rasterizer(
            gaussians,
            threads=self._config.threads,
            antialiased=self._base.metadata.antialiased,
        )
        sums = np.zeros((len(gaussians), 3))
        for camera, target, trusted in zip(
            self._cameras, self._targets, self._trusted, strict=True
        ):
            off = (target - rasterizer.render_colour(camera)) * trusted[..., None]
            sums += self._backward(camera, off)
        return sums

    def _gathered_weights(self) -> F64:
        weights = np.zeros(self._base.primitives)
        for camera, trusted in zip(self._cameras, self._trusted, strict=True):
            weights += self._backward(camera, np.repeat(trusted[..., None], 3, axis=2))[:, 0]
        return weights

    def _backward(self, camera: Camera, picture: F32) -> F64:
        """Return ``picture`` distributed to splats [N, 3] by their blending weights."""
        self._grey.forward(camera)
        self._grey.backward(np.ascontiguousarray(picture, np.float32))
        return self._grey.gradients()["sh"][:, 0].astype(np.float64) / SH_DC

    def _tell(self) -> None:
        if self._progress is not None:
            self._rounds += 1
            total = OUTLINE_ROUNDS + self._config.voxel_rounds + self._config.own_rounds
            self._progress("colours", self._rounds, max(total, self._rounds))


def _coloured(gaussians: Gaussians, rgb: F64, bands: int) -> Gaussians:
    sh = gaussians.sh.astype(np.float64)
    sh[:, 0] += rgb / SH_DC
    sh[:, 1:] *= bands / ALL_BANDS
    return replace(gaussians, sh=np.ascontiguousarray(sh, np.float32))


def _whole(numbers: F64) -> F64:
    """Round to whole numbers, a little towards 0."""
    return np.asarray(np.sign(numbers) * np.floor(np.abs(numbers) + 0.5 - DEAD_ZONE))


def _grey(gaussians: Gaussians) -> Gaussians:
    """Return the same splats, all of one grey, so that no gradient is clamped at black."""
    return replace(gaussians, sh=np.zeros((len(gaussians), 1, 3), np.float32))


def _ycc(rgb: F64) -> F64:
    red, green, blue = rgb.T
    return np.stack([0.25 * (red + blue) + 0.5 * green, red - green, blue - green], axis=1)
