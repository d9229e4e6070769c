"""A street of two textured planes, whose truth is known, as a renderer of the field."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.field import FULL, Quality, render_field_view
from rfcore.image import I420
from rfcore.views import View

INTRINSICS = Intrinsics(320, 192, 200.0, 200.0, 160.0, 96.0)
GROUND_M, WALL_M = 1.5, 14.0
SHARPNESS_PX_PER_M = 40.0


@cache
def texture(seed: int) -> NDArray[np.float32]:
    """Noise of many scales [1024, 1024], 0..1, at 40 px a metre: nothing in it repeats."""
    rng = np.random.default_rng(seed)
    sizes = (8, 16, 32, 64, 128, 256)
    layers = [
        cv2.resize(
            rng.random((size, size), np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC
        )
        for size in sizes
    ]
    mean = sum(layers) / len(layers)
    return np.clip(0.5 + 2.5 * (mean - 0.5), 0, 1).astype(np.float32)


class Planes:
    """Ray-traces a ground 1.5 m below the origin and a wall 14 m before it."""

    def render(self, camera: Camera, quality: Quality = FULL) -> View:
        """Return what ``camera`` sees; both planes are opaque."""
        del quality
        k = camera.intrinsics
        x, y = np.meshgrid(np.arange(k.width_px) + 0.5, np.arange(k.height_px) + 0.5)
        rays = np.stack([(x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px, np.ones_like(x)], -1)
        world = rays @ np.array(camera.world_from_cam.rotation_matrix()).T
        ox, oy, oz = camera.world_from_cam.translation_m
        with np.errstate(divide="ignore", invalid="ignore"):
            to_ground = np.where(world[..., 1] > 1e-9, (GROUND_M - oy) / world[..., 1], np.inf)
            to_wall = np.where(world[..., 2] > 1e-9, (WALL_M - oz) / world[..., 2], np.inf)
        depth = np.minimum(
            np.where(to_ground > 0, to_ground, np.inf), np.where(to_wall > 0, to_wall, np.inf)
        )
        hit = np.isfinite(depth) & (depth < 100)
        depth = np.where(hit, depth, 0.0)
        px, py, pz = (o + depth * world[..., i] for i, o in enumerate((ox, oy, oz)))
        ground = to_ground < to_wall
        colour = np.where(ground, _sampled(1, px, pz), _sampled(2, px, py))
        colour = np.where(hit, colour, 0.0).astype(np.float32)
        return View(
            np.repeat(colour[..., None], 3, 2), depth.astype(np.float32), hit.astype(np.float32)
        )


def _sampled(seed: int, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    scale = SHARPNESS_PX_PER_M
    at = [np.ascontiguousarray((v * scale) % 1024, np.float32) for v in (a, b)]
    return cv2.remap(texture(seed), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def picture(world_from_cam: Pose) -> I420:
    """Return what a camera there takes."""
    return render_field_view(Planes(), Camera(INTRINSICS, world_from_cam)).render
