"""Depth and class of what lies exactly behind the middle of each pixel.

Mitsuba's own depth is a distance along rays through random places of a pixel. Here one ray goes
through the pixel's centre, and its distance becomes z by the cosine to the optical axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics
from rfedge.street.geometry.mesh import F32, F64, Label
from rfedge.street.render.backend import Backend
from rfedge.street.render.stage import Stage

__all__ = ["cast_pixel_rays"]


def cast_pixel_rays(
    mi: Any, backend: Backend, stage: Stage, camera: Camera
) -> tuple[F32, NDArray[np.uint8]]:
    """Return z in metres float32 [H, W], infinite in the sky, and labels uint8 [H, W]."""
    k = camera.intrinsics
    directions, length = _directions(k)
    turned = directions @ np.array(camera.world_from_cam.rotation_matrix()).T
    cast = _cast_together if backend.vectorised else _cast_one_by_one
    distance_m, shape = cast(mi, stage, np.array(camera.world_from_cam.translation_m), turned)
    labels = np.append(stage.labels, Label.SKY)[shape].astype(np.uint8)
    depth_m = np.where(labels == Label.SKY, np.inf, distance_m / length).astype(np.float32)
    return depth_m.reshape(k.height_px, k.width_px), labels.reshape(k.height_px, k.width_px)


def _directions(k: Intrinsics) -> tuple[F64, F64]:
    """Unit vectors through the pixel centres [H W, 3] and how long they are at z = 1."""
    u, v = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
    rays = np.stack(
        [(u - k.cx_px) / k.fx_px, (v - k.cy_px) / k.fy_px, np.ones_like(u)], axis=-1
    ).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    return rays / length[:, None], length


def _cast_together(
    mi: Any, stage: Stage, origin: F64, towards: F64
) -> tuple[F64, NDArray[np.intp]]:
    import drjit

    rays = mi.Ray3f(
        mi.Point3f(*(mi.Float(np.full(len(towards), value, np.float32)) for value in origin)),
        mi.Vector3f(*(mi.Float(towards[:, axis].astype(np.float32)) for axis in range(3))),
    )
    hit = stage.scene.ray_intersect_preliminary(rays, coherent=True)
    numbers = np.array(drjit.reinterpret_array(mi.UInt32, hit.shape))
    known = np.array(drjit.reinterpret_array(mi.UInt32, stage.scene.shapes_dr()))
    index_of = np.full(max(known.max(), numbers.max()) + 1, len(known))
    index_of[known] = np.arange(len(known))
    return np.array(hit.t, np.float64), index_of[numbers]


def _cast_one_by_one(
    mi: Any, stage: Stage, origin: F64, towards: F64
) -> tuple[F64, NDArray[np.intp]]:
    index_of = {shape.id(): i for i, shape in enumerate(stage.scene.shapes())}
    distance_m = np.full(len(towards), np.inf)
    index = np.full(len(towards), len(index_of))
    for i, direction in enumerate(towards):
        ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
        hit = stage.scene.ray_intersect_preliminary(ray, coherent=True)
        if hit.is_valid():
            distance_m[i], index[i] = hit.t, index_of[hit.shape.id()]
    return distance_m, index
