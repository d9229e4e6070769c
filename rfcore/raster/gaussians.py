"""The parameters of a 3D Gaussian Splatting field, as plain arrays.

The same raw parameterisation as the INRIA reference (Kerbl et al. 2023): logarithmic scales,
unnormalised quaternions w, x, y, z, opacity logits, and real spherical harmonics coefficients
whose degree-0 band is offset by 0.5. Positions are float32 relative to the tile's origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput

__all__ = ["MAX_GAUSSIANS", "Gaussians"]

MAX_GAUSSIANS = 50_000_000
"""Upper limit accepted from files: 11.8 GB of parameters at SH degree 3."""

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
        expected = {
            "means": (n, 3),
            "quaternions": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh": (n, self.sh.shape[1], 3),
        }
        for name, shape in expected.items():
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
