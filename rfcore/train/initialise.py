"""The Gaussians a training run starts from.

One isotropic Gaussian a point, as wide as its neighbourhood (3DGS, section 5.1: the mean distance
to the three nearest neighbours), half opaque, of the point's colour from every side.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.errors import InvalidInput
from rfcore.raster.gaussians import Gaussians
from rfcore.views import PointCloud

__all__ = ["gaussians_from_points", "spacing_m"]

NEIGHBOURS = 3
MIN_SPACING_M = 1e-3
"""Coincident points have no spacing; this keeps their logarithm finite."""
MAX_SPACING_M = 20.0
"""A stray point far from all others would cover the picture."""
SH_DC = math.sqrt(1 / (4 * math.pi))
FLANN_KDTREE_SINGLE = 4
"""One exact tree: unlike FLANN's forests it does not depend on a random state."""

F32 = NDArray[np.float32]


def gaussians_from_points(
    points: PointCloud,
    count: int,
    scale: float,
    rng: np.random.Generator,
    *,
    sh_degree: int = 3,
) -> Gaussians:
    """Return Gaussians on ``count`` points drawn from ``points``, or on all.

    ``scale`` is a Gaussian's standard deviation in units of the distance to its neighbours.
    Raises ``InvalidInput`` for fewer than four points.
    """
    if len(points.xyz_m) <= NEIGHBOURS:
        raise InvalidInput("points", f"{len(points.xyz_m)} are too few, 4 or more are needed")
    chosen = np.sort(rng.permutation(len(points.xyz_m))[:count])
    means = np.ascontiguousarray(points.xyz_m[chosen], dtype=np.float32)
    n = len(means)
    log_scales = np.log(np.clip(spacing_m(means), MIN_SPACING_M, MAX_SPACING_M) * scale)
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (points.rgb[chosen] / 255.0 - 0.5) / SH_DC
    return Gaussians(
        means=means,
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.repeat(log_scales[:, None].astype(np.float32), 3, axis=1),
        opacity_logits=np.zeros(n, np.float32),
        sh=sh,
    )


def spacing_m(xyz_m: F32) -> NDArray[np.float64]:
    """Return the mean distance [N] of each of N >= 2 points to its three nearest neighbours."""
    index = cv2.flann.Index(xyz_m, {"algorithm": FLANN_KDTREE_SINGLE})
    nearest = min(NEIGHBOURS + 1, len(xyz_m))
    _, squared = index.knnSearch(xyz_m, nearest, params={})
    distances = np.sqrt(np.asarray(squared, dtype=np.float64))
    return np.asarray(distances[:, 1:].mean(axis=1))
