"""Surface points that a view sees: pixels taken by chance, carried back to where they came from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.dataset.source import SourcePoints
from rfcore.image import Rgb
from rfedge.street.geometry.mesh import F32, Label

__all__ = ["POINTS_PER_VIEW", "seen_points"]

POINTS_PER_VIEW = 1000


def seen_points(
    camera: Camera,
    rgb: Rgb,
    depth_m: F32,
    labels: NDArray[np.uint8],
    rng: np.random.Generator,
) -> SourcePoints:
    """Return at most 1000 points behind the centres of pixels that do not show the sky.

    They are spread over the surfaces rather than the picture: a pixel's chance grows with the
    square of its depth up to 30 m, as the area does that it covers.
    """
    rows, columns = np.nonzero(labels != Label.SKY)
    if len(rows) == 0:
        return SourcePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    z = depth_m[rows, columns].astype(np.float64)
    weight = np.minimum(z, 30.0) ** 2
    count = min(POINTS_PER_VIEW, len(rows))
    taken = rng.choice(len(rows), count, replace=False, p=weight / weight.sum())
    k = camera.intrinsics
    u, v, z = columns[taken] + 0.5, rows[taken] + 0.5, z[taken]
    local = np.stack([(u - k.cx_px) / k.fx_px * z, (v - k.cy_px) / k.fy_px * z, z], axis=1)
    rotation = np.array(camera.world_from_cam.rotation_matrix())
    xyz_m = local @ rotation.T + np.array(camera.world_from_cam.translation_m)
    return SourcePoints(xyz_m, rgb[rows[taken], columns[taken]])
