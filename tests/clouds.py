"""Fields of splats that are not turned and all of one size."""

import numpy as np
from numpy.typing import ArrayLike

from rfcore.field import SplatField
from rfcore.raster.gaussians import Gaussians


def upright(
    means: np.ndarray, sh: np.ndarray, size_m: ArrayLike, opacity_logit: float = 2.0
) -> SplatField:
    """Splats at ``means`` with one coefficient of colour each (n x 3)."""
    n = len(means)
    return SplatField(
        Gaussians(
            means=means.astype(np.float32),
            quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            log_scales=np.tile(np.log(size_m), (n, 3 // np.size(size_m))).astype(np.float32),
            opacity_logits=np.full(n, opacity_logit, np.float32),
            sh=sh.astype(np.float32)[:, None],
        )
    )


def cloud(
    seed: int, count: int, low_m: ArrayLike, high_m: ArrayLike, size_m: float, reach: float = 1.5
) -> SplatField:
    """Splats anywhere in a box, of any colour."""
    rng = np.random.default_rng(seed)
    sh = rng.uniform(-reach, reach, (count, 3))
    return upright(rng.uniform(low_m, high_m, (count, 3)), sh, size_m)
