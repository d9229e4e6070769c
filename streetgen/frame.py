"""Hold a rendered frame before it is a picture: linear light, depth, and the camera's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Camera
from rfcore.image import Rgb
from rfcore.lens import LensCamera

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class LinearFrame:
    """A frame in linear light.

    ``colour`` is float32 [H, W, 3], where 1 is white. ``depth_m`` is z, float32 [H, W], infinite in
    the sky. ``labels`` uint8 [H, W] are the classes of the pixels (``classes.Label``), or None
    where they are not known. ``velocity_mps`` and ``turn_radps`` are the camera's, in its own axes.
    """

    colour: F32
    depth_m: F32
    camera: Camera | LensCamera
    time_s: float = 0.0
    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    labels: NDArray[np.uint8] | None = None


def display_rgb(frame: LinearFrame) -> Rgb:
    """Return uint8 [H, W, 3] by the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(frame.colour, 0.0, 1.0)
    low, high = 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055
    return np.floor(np.where(linear <= 0.0031308, low, high) * 255 + 0.5).astype(np.uint8)


def sampled(values: F32, u_px: F32, v_px: F32) -> F32:
    """Sample [H, W, C] bilinearly at pixel positions [H', W'], edges repeated."""
    height, width = values.shape[:2]
    x = np.clip(u_px - 0.5, 0, width - 1)
    y = np.clip(v_px - 0.5, 0, height - 1)
    left = np.minimum(x.astype(np.intp), width - 2)
    top = np.minimum(y.astype(np.intp), height - 2)
    right_share, low_share = (x - left)[..., None], (y - top)[..., None]
    upper = values[top, left] * (1 - right_share) + values[top, left + 1] * right_share
    lower = values[top + 1, left] * (1 - right_share) + values[top + 1, left + 1] * right_share
    return np.asarray(upper * (1 - low_share) + lower * low_share, dtype=np.float32)
