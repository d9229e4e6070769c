"""The clear sky and the sun behind the air.

Preetham, Shirley and Smits, "A practical analytic model for daylight", SIGGRAPH 1999: the sky's
luminance and chromaticity are Perez functions of two angles, with coefficients linear in the
turbidity (2: mountain air, 3: clear, 6: hazy); the sun passes Rayleigh, aerosol and ozone layers.
"""

from __future__ import annotations

import math

import numpy as np

from rfcore.errors import InvalidInput
from rfedge.street.geometry.material import Colour
from rfedge.street.geometry.mesh import F32, F64

__all__ = ["SUN_DIAMETER_DEG", "clear_radiance", "sun_disc_sr", "sun_radiance"]

SUN_DIAMETER_DEG = 0.53
SUN_ABOVE_AIR_KLUX = 128.0
"""Solar illuminance constant."""

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
"""Zenith chromaticity: rows by turbidity squared, turbidity, 1; columns by cubes of the angle."""
RGB_FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""IEC 61966-2-1."""
WAVELENGTHS_UM = np.array([0.615, 0.535, 0.445])
"""Where red, green and blue of sRGB are purest, roughly."""
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
    """F(view) / F(zenith) of equation 3."""
    a, b, c, d, e = table @ (turbidity, 1.0)

    def perez(cos_away: F64 | float, cos_gamma: F64 | float) -> F64:
        gamma = np.arccos(cos_gamma)
        glow = 1 + c * np.exp(d * gamma) + e * np.square(cos_gamma)
        return np.asarray((1 + a * np.exp(b / cos_away)) * glow)

    return np.asarray(perez(cos_view, cos_sun) / perez(1.0, min(up, 1.0)))


def _zenith(table: F64, turbidity: float, away: float) -> float:
    squares, lines, fixed = (float(np.polyval(row, away)) for row in table)
    return turbidity**2 * squares + turbidity * lines + fixed
