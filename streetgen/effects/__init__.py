"""Register the effects that a scene may declare, and import those that it does declare.

Effects run in the order below. Effects on the street change what is rendered: geometry, light and
shade, surfaces. Effects of the air and the sensor change rendered frames. These are linear, so that
another exposure or another noise needs no new render.

Each effect is a module with one frozen dataclass, its settings. Settings of an effect on the street
have ``change(world, rng) -> world``, those of an effect on frames ``apply(frame, rng) -> frame``. A
scene has one light.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from typing import Any

import numpy as np


class EffectKind(StrEnum):
    """The part of a scene or frame that an effect changes."""

    GEOMETRY = "geometry"
    LIGHT = "light"
    SHADE = "shade"
    SURFACE = "surface"
    AIR = "air"
    SENSOR = "sensor"


@dataclass(frozen=True)
class Effect:
    """An entry of the registry; the module ``streetgen.effects.<name>`` has ``settings``."""

    name: str
    kind: EffectKind
    settings: str
    why: str

    @property
    def on_frames(self) -> bool:
        """True if the effect changes rendered frames, false if it changes the scene."""
        return self.kind in (EffectKind.AIR, EffectKind.SENSOR)


EFFECTS = (
    Effect("tunnel", EffectKind.GEOMETRY, "Tunnel", "a stretch of the road is roofed"),
    Effect("works", EffectKind.GEOMETRY, "Works", "a building site stands beside the lane"),
    Effect("parked", EffectKind.GEOMETRY, "ParkedVehicles", "vehicles stand in the parking bays"),
    Effect("traffic", EffectKind.GEOMETRY, "Traffic", "vehicles drive on both lanes"),
    Effect("pedestrians", EffectKind.GEOMETRY, "Pedestrians", "people walk, some across the road"),
    Effect("cyclists", EffectKind.GEOMETRY, "Cyclists", "people ride at the edges of the road"),
    Effect("dusk", EffectKind.LIGHT, "Dusk", "the sun is low"),
    Effect("evening", EffectKind.LIGHT, "Evening", "the sun sinks from noon to dusk"),
    Effect("overcast", EffectKind.LIGHT, "Overcast", "clouds hide the sun"),
    Effect("passing_cloud", EffectKind.SHADE, "PassingCloud", "a cloud hides the sun for a while"),
    Effect("wet_road", EffectKind.SURFACE, "WetRoad", "water darkens the ground and mirrors"),
    Effect("haze", EffectKind.AIR, "Haze", "distant things lose contrast"),
    Effect("rain", EffectKind.AIR, "Rain", "falling drops streak over the picture"),
    Effect("lens", EffectKind.SENSOR, "LensDistortion", "straight lines bend"),
    Effect("rolling_shutter", EffectKind.SENSOR, "RollingShutter", "rows are exposed one by one"),
    Effect("exposure", EffectKind.SENSOR, "ExposureDrift", "brightness drifts over a drive"),
    Effect("auto_exposure", EffectKind.SENSOR, "AutoExposure", "the exposure overshoots"),
    Effect("noise", EffectKind.SENSOR, "SensorNoise", "photons and electrons are counted"),
)


def load_effect(effect: Effect) -> type[Any]:
    """Import an effect's module and return its settings."""
    settings: type[Any] = getattr(import_module(f"{__name__}.{effect.name}"), effect.settings)
    return settings


def rng_of(effect: Effect, seed: int, frame: int) -> np.random.Generator:
    """Return the random numbers of one effect in one frame, whatever other effects run."""
    return np.random.default_rng([seed, frame, zlib.crc32(effect.name.encode())])
