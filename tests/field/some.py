"""Small sets of Gaussians."""

import numpy as np

from rfcore.raster.gaussians import Gaussians, gaussian_shapes


def make_gaussians(n: int = 5, sh_degree: int = 3, seed: int = 0) -> Gaussians:
    """Return ``n`` random Gaussians of an SH degree."""
    rng = np.random.default_rng(seed)
    shapes = gaussian_shapes(n, sh_degree)
    return Gaussians(**{k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()})
