"""Let a cloud pass before the sun: its shadow falls on the whole street for some seconds.

The sun's disc is dimmed; the sky and the exposure stay as they are. On a scene without a sun it
changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.world import Sky, World


@dataclass(frozen=True)
class PassingCloud:
    """The times of the shade and the share of light that it lets pass.

    From ``start_s`` on the sun is dimmed, within ``edge_s``, to the share ``passed`` of its light.
    After ``shade_s`` of shade it comes back within ``edge_s``.
    """

    start_s: Annotated[float, Range(0, 3600)] = 1.0
    edge_s: Annotated[float, Range(0.01, 60)] = 0.5
    shade_s: Annotated[float, Range(0, 3600)] = 2.0
    passed: Annotated[float, Range(0, 1)] = 0.05

    def change(self, world: World, _rng: np.random.Generator) -> World:
        """Return the world with the cloud on its way."""
        clear_at = world.sky_at or partial(_always, world.sky)
        sky_at = partial(_shaded, self, clear_at)
        return replace(world, sky=sky_at(0.0), sky_at=sky_at)

    def sunlight_at(self, time_s: float) -> float:
        """Return which share of the sun's light comes through."""
        end_s = self.start_s + 2 * self.edge_s + self.shade_s
        inside_s = min(time_s - self.start_s, end_s - time_s)
        cover = min(max(inside_s / self.edge_s, 0.0), 1.0)
        return 1.0 - (1.0 - self.passed) * cover


def _always(sky: Sky, _time_s: float) -> Sky:
    return sky


def _shaded(cloud: PassingCloud, clear_at: Callable[[float], Sky], time_s: float) -> Sky:
    sky, share = clear_at(time_s), cloud.sunlight_at(time_s)
    red, green, blue = sky.sun_radiance
    return replace(sky, sun_radiance=(share * red, share * green, share * blue))
