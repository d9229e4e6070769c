"""Compute the light over the street: clear skies with clouds, evenings, overcast skies.

Row i of a sky picture [H, 2 H, 3] looks (i + 0.5) / H pi away from the zenith, column j
(j + 0.5) / H pi from x towards y. Radiance is in kcd/m^2, so that irradiance is in klux.

The clear sky follows Preetham, Shirley and Smits, "A practical analytic model for daylight",
SIGGRAPH 1999. Luminance and chromaticity are Perez functions of two angles, whose coefficients are
linear in the turbidity (2: mountain air, 3: clear, 6: hazy). The sun's light passes Rayleigh,
aerosol and ozone layers.

``exposure`` is fixed for each light, not derived from pictures, so that the frames of a drive stay
comparable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rfcore.errors import InvalidInput
from streetgen.geometry.cloud import (
    CloudLight,
    cumulus,
    margined,
    over,
    periodic_at,
    with_sun_free,
)
from streetgen.geometry.mesh import F32, F64, Colour
from streetgen.geometry.world import Sky

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


SUN_DIAMETER_DEG = 0.53
SUN_ABOVE_AIR_KLUX = 128.0
"""The solar illuminance constant."""
LUMINANCE = np.array(
    [
        (0.1787, -1.4630),
        (-0.3554, 0.4275),
        (-0.0227, 5.3251),
        (0.1206, -2.5771),
        (-0.0670, 0.3703),
    ]
)
CHROMA_X = np.array(
    [
        (-0.0193, -0.2592),
        (-0.0665, 0.0008),
        (-0.0004, 0.2125),
        (-0.0641, -0.8989),
        (-0.0033, 0.0452),
    ]
)
CHROMA_Y = np.array(
    [
        (-0.0167, -0.2608),
        (-0.0950, 0.0092),
        (-0.0079, 0.2102),
        (-0.0441, -1.6537),
        (-0.0109, 0.0529),
    ]
)
"""Perez A..E as slope and offset in turbidity, appendix A.2 of the paper."""
ZENITH_X = np.array(
    [
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ]
)
ZENITH_Y = np.array(
    [
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ]
)
"""Zenith chromaticity: a row for turbidity squared, turbidity and 1, a column for each power."""
RGB_FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""The matrix of IEC 61966-2-1."""
WAVELENGTHS_UM = np.array([0.615, 0.535, 0.445])
"""Approximate wavelengths of the primaries of sRGB."""
OZONE_PER_CM = np.array([0.110, 0.070, 0.005])
OZONE_CM = 0.35
LOWEST_DEG = 1.0


def clear_radiance(view: F32, sun_towards: tuple[float, float, float], turbidity: float) -> F32:
    """Return the radiance float32 [..., 3] of a cloudless sky in directions [..., 3], no sun disc.

    Below the horizon it is the horizon's. Raises ``InvalidInput`` for a sun below 1 degree, where
    the model does not hold.
    """
    sun = np.asarray(sun_towards, np.float64)
    if not sun[2] >= math.sin(math.radians(LOWEST_DEG)) - 1e-9:
        raise InvalidInput("sun_towards", f"{sun_towards} is lower than {LOWEST_DEG:g} degree")
    cos_view = np.maximum(view[..., 2].astype(np.float64), 0.01)
    cos_sun = np.clip(view @ sun, -1.0, 1.0)
    away = math.acos(min(sun[2], 1.0))
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * away)
    zenith = (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192
    luminance = max(zenith, 0.05) * _perez(LUMINANCE, turbidity, cos_view, cos_sun, sun[2])
    x = _zenith(ZENITH_X, turbidity, away) * _perez(CHROMA_X, turbidity, cos_view, cos_sun, sun[2])
    y = _zenith(ZENITH_Y, turbidity, away) * _perez(CHROMA_Y, turbidity, cos_view, cos_sun, sun[2])
    xyz = np.stack([x / y, np.ones_like(y), (1 - x - y) / y], axis=-1) * luminance[..., None]
    return np.asarray(np.maximum(xyz @ RGB_FROM_XYZ.T, 0.0), np.float32)


def sun_radiance(elevation_deg: float, turbidity: float) -> Colour:
    """Return the radiance of the sun's disc as red, green and blue after the air's losses."""
    away_deg = 90.0 - elevation_deg
    mass = 1 / (math.cos(math.radians(away_deg)) + 0.15 * (93.885 - away_deg) ** -1.253)
    depth = 0.008735 * WAVELENGTHS_UM**-4.08
    depth = depth + (0.04608 * turbidity - 0.04586) * WAVELENGTHS_UM**-1.3
    depth = depth + OZONE_PER_CM * OZONE_CM
    passed = np.exp(-mass * depth) * SUN_ABOVE_AIR_KLUX / sun_disc_sr(SUN_DIAMETER_DEG)
    return float(passed[0]), float(passed[1]), float(passed[2])


def sun_disc_sr(diameter_deg: float) -> float:
    """Return the solid angle of a disc in the sky."""
    return 2 * math.pi * (1 - math.cos(math.radians(0.5 * diameter_deg)))


def _perez(table: F64, turbidity: float, cos_view: F64, cos_sun: F64, up: float) -> F64:
    """Return F(view) / F(zenith) of equation 3."""
    a, b, c, d, e = table @ (turbidity, 1.0)

    def perez(cos_away: F64 | float, cos_gamma: F64 | float) -> F64:
        gamma = np.arccos(cos_gamma)
        glow = 1 + c * np.exp(d * gamma) + e * np.square(cos_gamma)
        return np.asarray((1 + a * np.exp(b / cos_away)) * glow)

    return np.asarray(perez(cos_view, cos_sun) / perez(1.0, min(up, 1.0)))


def _zenith(table: F64, turbidity: float, away: float) -> float:
    squares, lines, fixed = (float(np.polyval(row, away)) for row in table)
    return turbidity**2 * squares + turbidity * lines + fixed


HEIGHT = 1024
"""Rows of a sky picture: 0.18 degrees each, 3 px of a 1920x1080 picture 90 degrees wide."""
OVERCAST_ZENITH_KCD = 9.0
OVERCAST_TINT = np.array([0.97, 1.0, 1.05])


@dataclass(frozen=True)
class Daylight:
    """The sun's direction, the haze, the clouds and the exposure.

    The exposure is given by ``white``, the linear light in the picture of a white sheet that leans
    halfway towards the sun.
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
DUSK = Daylight(azimuth_deg=197.0, elevation_deg=6.0, turbidity=2.5, cover=0.4, white=0.9)


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
    """Return the unevenness [H, 2 H] of the clouds' undersides, of mean 0."""
    cells = 1024
    f = np.hypot(np.fft.fftfreq(cells)[:, None], np.fft.rfftfreq(cells)[None]) * cells
    white = np.fft.rfft2(rng.standard_normal((cells, cells)))
    noise = np.fft.irfft2(white * np.maximum(f, 3.0) ** -1.35, s=(cells, cells))
    up = np.maximum(view[..., 2], 0.08)
    place = np.moveaxis(view[..., :2] / up[..., None], -1, 0) * (70 / cells)
    seen = periodic_at(margined(noise.astype(np.float32)), place.astype(np.float32))
    far = np.exp(-0.12 / np.maximum(view[..., 2], 1e-3))
    return np.asarray(seen / noise.std() * far, np.float32)
