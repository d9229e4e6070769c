"""The dome over the street: which way each pixel of a sky picture looks, and the ground's share.

Angles as in ``world.Sky``: row i of a picture [H, 2 H, 3] looks (i + 0.5) / H pi away from the
zenith, column j (j + 0.5) / H pi from x towards y. Radiance is in kcd/m^2, so that irradiance is in
klux.
"""

from __future__ import annotations

import math

import numpy as np

from rfedge.street.geometry.mesh import F32, F64

__all__ = ["directions", "horizontal_irradiance", "towards", "with_ground"]

GROUND_ALBEDO = 0.15


def towards(azimuth_deg: float, elevation_deg: float) -> tuple[float, float, float]:
    """Return the unit vector at an azimuth, from x towards y, and an elevation."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)


def directions(height: int) -> F32:
    """Return the unit vectors float32 [H, 2 H, 3] of a sky picture's pixels."""
    away = (np.arange(height) + 0.5) / height * np.pi
    around = (np.arange(2 * height) + 0.5) / height * np.pi
    level = np.sin(away)[:, None]
    up = np.broadcast_to(np.cos(away)[:, None], (height, 2 * height))
    return np.stack([level * np.cos(around), level * np.sin(around), up], axis=2).astype(np.float32)


def horizontal_irradiance(radiance: F32) -> F64:
    """Return what a level surface receives from the upper half, float64 [3]."""
    height = len(radiance)
    away = (np.arange(height // 2) + 0.5) / height * np.pi
    weight = np.cos(away) * np.sin(away) * (np.pi / height) ** 2
    rows = radiance[: height // 2].sum(axis=1, dtype=np.float64)
    return np.asarray(weight @ rows, np.float64)


def with_ground(radiance: F32, sun_klux: F64) -> F32:
    """Return the picture with its lower half as grey ground under this sky and sun."""
    received = horizontal_irradiance(radiance) + sun_klux
    lit = radiance.copy()
    lit[len(lit) // 2 :] = GROUND_ALBEDO * received / np.pi
    return lit
