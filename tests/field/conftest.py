"""Small sets of Gaussians."""

from collections.abc import Callable

import numpy as np
import pytest

from rfcore.raster.gaussians import Gaussians, gaussian_shapes

Make = Callable[..., Gaussians]


@pytest.fixture(scope="session")
def make_gaussians() -> Make:
    """Return a maker of ``n`` random Gaussians of an SH degree."""

    def make(n: int = 5, sh_degree: int = 3, seed: int = 0) -> Gaussians:
        rng = np.random.default_rng(seed)
        shapes = gaussian_shapes(n, sh_degree)
        return Gaussians(**{k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()})

    return make
