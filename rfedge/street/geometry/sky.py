"""The light over the street: a day with clouds, an evening, an overcast sky.

``exposure`` is fixed for each light, as a photographer would set it for the street, not found from
pictures: frames of one drive stay comparable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rfcore.errors import InvalidInput
from rfedge.street.geometry.cloud import CloudLight, cumulus, over, with_sun_free
from rfedge.street.geometry.mesh import F32, F64
from rfedge.street.geometry.periodic import margined, periodic_at
from rfedge.street.geometry.sky_clear import (
    SUN_DIAMETER_DEG,
    clear_radiance,
    sun_disc_sr,
    sun_radiance,
)
from rfedge.street.geometry.sky_dome import (
    directions,
    horizontal_irradiance,
    towards,
    with_ground,
)
from rfedge.street.geometry.world import Sky

__all__ = ["HEIGHT", "NOON", "Daylight", "clear_sky", "overcast_sky", "sunny_sky"]

HEIGHT = 1024
"""Rows of a sky picture: 0.18 degrees each, three pixels of a 1920x1080 picture 90 degrees wide."""
OVERCAST_ZENITH_KCD = 9.0
OVERCAST_TINT = np.array([0.97, 1.0, 1.05])


@dataclass(frozen=True)
class Daylight:
    """Where the sun stands, how hazy the air is, and how much of the sky has clouds.

    ``white`` is the linear light that a white sheet, leaning halfway towards the sun, gets in the
    picture: the exposure.
    """

    azimuth_deg: float
    elevation_deg: float
    turbidity: float
    cover: float
    white: float = 1.6

    def __post_init__(self) -> None:
        if not 1.0 <= self.elevation_deg <= 90.0:
            raise InvalidInput("elevation_deg", f"is {self.elevation_deg}, outside 1..90")
        if not 1.8 <= self.turbidity <= 10.0:
            raise InvalidInput("turbidity", f"is {self.turbidity}, outside 1.8..10")
        if not 0.0 <= self.cover <= 0.9:
            raise InvalidInput("cover", f"is {self.cover}, outside 0..0.9")


NOON = Daylight(azimuth_deg=35.0, elevation_deg=52.0, turbidity=3.0, cover=0.35)


def clear_sky(rng: np.random.Generator) -> Sky:
    """Return the light of a scene that names no other: noon, with some clouds."""
    return sunny_sky(NOON, rng)


def sunny_sky(day: Daylight, rng: np.random.Generator, height: int = HEIGHT) -> Sky:
    """Return a sky whose sun shines between the clouds."""
    sun = towards(day.azimuth_deg, day.elevation_deg)
    disc = sun_radiance(day.elevation_deg, day.turbidity)
    sun_klux = np.array(disc) * sun_disc_sr(SUN_DIAMETER_DEG)
    upper = directions(height)[: height // 2]
    above = clear_radiance(upper, sun, day.turbidity)
    if day.cover > 0:
        light = CloudLight(sun_klux, sun, above.mean(axis=(0, 1)))
        above = over(above, upper, with_sun_free(cumulus(rng, day.cover), sun), light)
    radiance = np.concatenate([above, np.zeros_like(above)])
    return Sky(
        radiance=with_ground(radiance, sun_klux * sun[2]),
        sun_towards=sun,
        sun_radiance=disc,
        sun_diameter_deg=SUN_DIAMETER_DEG,
        exposure=_exposure(radiance, sun_klux * 0.5 * (1 + sun[2]), day.white),
    )


def overcast_sky(
    unevenness: float, white: float, rng: np.random.Generator, height: int = HEIGHT
) -> Sky:
    """Return a closed layer of cloud without a sun, its underside ``unevenness`` bright or dark.

    Moon and Spencer's gradient (CIE standard overcast sky): the horizon is a third of the zenith.
    ``white`` is the linear light of a level white sheet in the picture.
    """
    view = directions(height)
    up = np.maximum(view[..., 2], 0.0)
    layer = np.clip(1 + unevenness * _ceiling(rng, view), 0.3, 2.0)
    grey = (OVERCAST_ZENITH_KCD * (1 + 2 * up) / 3 * layer).astype(np.float32)
    radiance = (grey[..., None] * OVERCAST_TINT).astype(np.float32)
    return Sky(
        radiance=with_ground(radiance, np.zeros(3)),
        exposure=_exposure(radiance, np.zeros(3), white),
    )


def _exposure(radiance: F32, sun_klux: F64, white: float) -> float:
    lit = (horizontal_irradiance(radiance) + sun_klux).mean() / np.pi
    return float(white / lit)


def _ceiling(rng: np.random.Generator, view: F32) -> F32:
    """Uneven undersides [H, 2 H] of mean 0, fading towards the horizon."""
    cells = 1024
    f = np.hypot(np.fft.fftfreq(cells)[:, None], np.fft.rfftfreq(cells)[None]) * cells
    white = np.fft.rfft2(rng.standard_normal((cells, cells)))
    noise = np.fft.irfft2(white * np.maximum(f, 3.0) ** -1.35, s=(cells, cells))
    up = np.maximum(view[..., 2], 0.08)
    place = np.moveaxis(view[..., :2] / up[..., None], -1, 0) * (70 / cells)
    seen = periodic_at(margined(noise.astype(np.float32)), place.astype(np.float32))
    far = np.exp(-0.12 / np.maximum(view[..., 2], 1e-3))
    return np.asarray(seen / noise.std() * far, np.float32)
