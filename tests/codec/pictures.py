"""Procedural street-like pictures: smooth shading, edges, texture; all seeded."""

import numpy as np

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.image import I420
from rfcore.native.yuv import i420_from_colour
from rfcore.views import FieldView


def picture(width_px: int, height_px: int, shift_px: float = 0.0, cars: int = 0) -> I420:
    """Facades, road and sky seen by a camera moved ``shift_px`` to the side, with ``cars``."""
    x, y = np.meshgrid(np.arange(width_px) + shift_px, np.arange(height_px))
    scale = 640 / max(width_px, height_px)
    x, y = x * scale, y * scale
    luma = 0.45 + 0.2 * np.sin(x / 47) * np.cos(y / 31)
    luma += 0.15 * (np.sin(x / 9) > 0.6) * (np.sin(y / 11) > 0.3)
    luma += 0.05 * np.sin(x * 1.3) * np.sin(y * 0.9)
    for car in range(cars):
        inside = (np.abs(x - 120 - 150 * car) < 45) & (np.abs(y - 220) < 25)
        luma = np.where(inside, 0.8 - 0.3 * car, luma)
    tint = np.stack([1 + 0.1 * np.sin(x / 80), np.ones_like(x), 1 - 0.1 * np.sin(y / 60)], -1)
    return i420_from_colour((luma[..., None] * tint).astype(np.float32))


def view_of(render: I420) -> FieldView:
    """Return a view that shows ``render`` and no surface: nothing can be carried from or to it."""
    width_px, height_px = render.size_px
    k = Intrinsics(width_px, height_px, width_px, width_px, width_px / 2, height_px / 2)
    depth = np.zeros((height_px, width_px), np.float32)
    return FieldView(Camera(k, Pose.identity()), render, depth)


def pair(width_px: int, height_px: int, shift_px: float = 0.0) -> tuple[I420, FieldView]:
    """Return (camera frame, field's view): the camera sees two cars and noise that the field does
    not know."""
    camera = picture(width_px, height_px, shift_px, cars=2)
    rng = np.random.default_rng(7)
    noise = np.rint(rng.normal(0, 2, camera.y.shape))
    noisy = np.clip(camera.y + noise, 0, 255).astype(np.uint8)
    view = view_of(picture(width_px, height_px, shift_px))
    return I420(noisy, camera.u, camera.v), view


def evening(picture: I420, evening: float) -> I420:
    """Return a street as the sun sets: at 0 as it is, at 1 dark and blue, but for what a lamp on
    the left still lights. No matrix says that: what it adds depends on the place."""
    width_px = picture.size_px[0]
    lit = (1 + evening * np.linspace(0.1, -0.65, width_px))[None, :]
    chroma = lit[:, ::2]
    y = (picture.y - 16.0) * lit + 16
    u = (picture.u - 128.0) * chroma + 128 + 12 * (1 - chroma)
    v = (picture.v - 128.0) * chroma + 128
    return I420(*(np.clip(np.rint(p), 1, 255).astype(np.uint8) for p in (y, u, v)))


def flat(width_px: int, height_px: int, level: int) -> I420:
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    return I420(*(np.full(s, level, np.uint8) for s in ((height_px, width_px), half, half)))


def noise(width_px: int, height_px: int, seed: int) -> I420:
    """Uniform noise over all 256 values, zero included."""
    rng = np.random.default_rng(seed)
    half = ((height_px + 1) // 2, (width_px + 1) // 2)
    shapes = ((height_px, width_px), half, half)
    return I420(*(rng.integers(0, 256, s, dtype=np.uint8) for s in shapes))
