"""The sky as Mitsuba's environment map, the sun painted into it.

One emitter, not two: the path tracer picks an emitter by chance for each shadow ray, so that a
separate sun would get half of them. A map is sampled by its radiance, which goes to the sun anyway.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rfedge.street.geometry.mesh import F32, F64
from rfedge.street.geometry.world import Sky

__all__ = ["environment", "with_sun"]

ROWS = 512
"""Of the map that is handed over: 0.35 degrees a pixel, so that the sun is a few of them."""
LEAST_SUN_PX = 1.5


def environment(mi: Any, sky: Sky) -> dict[str, Any]:
    """Return the description that ``mi.load_dict`` takes.

    Mitsuba's map has its zenith along y and column 0 along -z there; turned upright by 90 degrees
    about x that is world +y, and the columns run from there towards -x (clockwise).
    """
    radiance = with_sun(sky)
    columns = radiance.shape[1]
    ours = (columns // 4 + columns - 1 - np.arange(columns)) % columns
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance[:, ours]))
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": bitmap, "to_world": upright}


def with_sun(sky: Sky) -> F32:
    """Return the sky's radiance, at least 512 rows of it, with the sun's light in its disc.

    The disc covers whole pixels; its radiance is scaled so that the light stays what the disc of
    ``sun_diameter_deg`` would give.
    """
    repeat = -(-ROWS // len(sky.radiance))
    radiance = sky.radiance.repeat(repeat, axis=0).repeat(repeat, axis=1)
    if max(sky.sun_radiance) == 0:
        return radiance
    rows = len(radiance)
    towards, solid_angle = _directions(rows)
    cosine = towards @ np.array(sky.sun_towards)
    radius = max(np.radians(sky.sun_diameter_deg) / 2, LEAST_SUN_PX * np.pi / rows)
    inside = cosine > np.cos(radius)
    true_angle = 2 * np.pi * (1 - np.cos(np.radians(sky.sun_diameter_deg) / 2))
    share = true_angle / solid_angle[inside].sum()
    radiance[inside] += (np.array(sky.sun_radiance) * share).astype(np.float32)
    return radiance


def _directions(rows: int) -> tuple[F64, F64]:
    """Where each pixel of a map looks [H, 2 H, 3], and the solid angle that it covers [H, 2 H]."""
    down = (np.arange(rows) + 0.5) / rows * np.pi
    round_ = (np.arange(2 * rows) + 0.5) / rows * np.pi
    theta, phi = np.meshgrid(down, round_, indexing="ij")
    towards = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )
    return towards, np.sin(theta) * (np.pi / rows) ** 2
