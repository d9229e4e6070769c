"""Which splats a quality draws.

Rung ``detail`` of N splats is the first ``ceil(detail * N)`` of them in the archive's order, so
that every rung is a prefix of the next; with ``sh_degree`` D the coefficients of the first D bands.
``detail`` is one of ``quality.DETAILS`` and the product is taken in whole numbers: the same splats
on every machine.
"""

from __future__ import annotations

import numpy as np

from rfcore.raster.gaussians import Gaussians

__all__ = ["kept_of", "rung"]


def kept_of(count: int, detail: float) -> int:
    """Return how many of ``count`` splats rung ``detail`` draws."""
    return -(-count * round(detail * 100) // 100)


def rung(gaussians: Gaussians, detail: float, sh_degree: int) -> Gaussians:
    """Return the splats of one rung; all of them, unchanged, for 1 and the field's own degree."""
    kept, bands = kept_of(len(gaussians), detail), (sh_degree + 1) ** 2
    if kept == len(gaussians) and bands == gaussians.sh.shape[1]:
        return gaussians
    return Gaussians(
        means=gaussians.means[:kept],
        quaternions=gaussians.quaternions[:kept],
        log_scales=gaussians.log_scales[:kept],
        opacity_logits=gaussians.opacity_logits[:kept],
        sh=np.ascontiguousarray(gaussians.sh[:kept, :bands]),
    )
