"""The parameters of a 3D Gaussian Splatting field, as plain arrays.

The same raw parameterisation as the INRIA reference (Kerbl et al. 2023): logarithmic scales,
unnormalised quaternions w, x, y, z, opacity logits, and real spherical harmonics coefficients
whose degree-0 band is offset by 0.5. Positions are float32 relative to the tile's origin.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

MAX_GAUSSIANS = 50_000_000
"""Upper limit accepted from files: 11.8 GB of parameters at SH degree 3."""
SKY_M = 1e4
"""Gaussians whose centre is deeper than this in a picture are sky: they are no surface's depth."""

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians with view-dependent colour.

    ``means`` [N, 3] m; ``quaternions`` [N, 4] w, x, y, z, any non-zero norm; ``log_scales``
    [N, 3] natural log of metres; ``opacity_logits`` [N]; ``sh`` [N, (D+1)^2, 3], D = 0..3.
    All float32 and C-contiguous. Raises ``InvalidInput`` on shape, dtype or non-finite values.
    """

    means: F32
    quaternions: F32
    log_scales: F32
    opacity_logits: F32
    sh: F32

    def __post_init__(self) -> None:
        n = len(self.means)
        if not 0 <= n <= MAX_GAUSSIANS:
            raise InvalidInput("gaussians", f"{n} is outside 0..{MAX_GAUSSIANS}")
        if self.sh.ndim != 3 or self.sh.shape[1] not in (1, 4, 9, 16):
            raise InvalidInput(
                "gaussians.sh", f"shape {self.sh.shape} is not [N, K, 3] with K = 1, 4, 9 or 16"
            )
        for name, shape in gaussian_shapes(n, self.sh_degree).items():
            array = getattr(self, name)
            if array.shape != shape:
                raise InvalidInput(f"gaussians.{name}", f"shape {array.shape}, expected {shape}")
            if array.dtype != np.float32 or not array.flags.c_contiguous:
                raise InvalidInput(f"gaussians.{name}", "must be contiguous float32")
            if not np.isfinite(array).all():
                bad = np.flatnonzero(~np.isfinite(array.reshape(n, -1)).all(axis=1))
                raise InvalidInput(
                    f"gaussians.{name}",
                    f"{len(bad)} of {n} Gaussians are not finite, the first is number {bad[0]}",
                )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree D of the spherical harmonics, 0..3."""
        return isqrt(self.sh.shape[1]) - 1


def gaussian_shapes(count: int, sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of ``count`` Gaussians, by name."""
    return {
        "means": (count, 3),
        "quaternions": (count, 4),
        "log_scales": (count, 3),
        "opacity_logits": (count,),
        "sh": (count, (sh_degree + 1) ** 2, 3),
    }


def empty_arrays(count: int, sh_degree: int) -> dict[str, F32]:
    """Return arrays for ``count`` Gaussians, whose numbers are still to be written."""
    shapes = gaussian_shapes(count, sh_degree)
    return {name: np.empty(shape, np.float32) for name, shape in shapes.items()}


def sky_of(means: F32) -> NDArray[np.bool_]:
    """Return which of the means [N, 3] are further than ``SKY_M`` from their median on an axis.

    If that is half of them or more, none is sky: a scene may be that large.
    """
    if not len(means) or np.ptp(means, axis=0).max() <= SKY_M:
        return np.zeros(len(means), np.bool_)  # without finding the median, which takes longer
    middle = np.median(means, axis=0)
    is_far = np.asarray((np.abs(means - middle) > SKY_M).any(axis=1))
    return np.asarray(is_far & (2 * is_far.sum() < len(means)))


def with_sky_at(gaussians: Gaussians, distance_m: float) -> Gaussians:
    """Return ``gaussians`` with the sky moved to this distance, at the same angular size."""
    is_sky = sky_of(gaussians.means)
    if not is_sky.any():
        return gaussians
    middle = np.median(gaussians.means, axis=0).astype(np.float64)
    offset = gaussians.means[is_sky] - middle
    nearer = distance_m / np.linalg.norm(offset, axis=1, keepdims=True)
    means, log_scales = gaussians.means.copy(), gaussians.log_scales.copy()
    means[is_sky] = middle + offset * nearer
    log_scales[is_sky] += np.log(nearer).astype(np.float32)
    return replace(gaussians, means=means, log_scales=log_scales)


def joined(*parts: Gaussians) -> Gaussians:
    """Return the Gaussians of all parts, one part after the other, of the same SH degree."""
    return Gaussians(
        **{
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(Gaussians)
        }
    )
