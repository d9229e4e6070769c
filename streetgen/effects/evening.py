"""Light the street by a sun between noon and dusk, which may sink while the camera drives.

A share of 0 is the noon of a scene without a light, a share of 1 the default of ``dusk``. The sun's
direction, the haze, the clouds' cover and the exposure are interpolated linearly between them. The
clouds keep their shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Annotated

import numpy as np

from rfcore.tables import Range
from streetgen.geometry.sky import DUSK, NOON, Daylight, sunny_sky
from streetgen.geometry.world import Sky, World


@dataclass(frozen=True)
class Evening:
    """The share between noon and dusk: ``start`` at time 0, ``end`` from ``over_s`` on."""

    start: Annotated[float, Range(0, 1)] = 0.0
    end: Annotated[float, Range(0, 1)] = 1.0
    over_s: Annotated[float, Range(0.01, 3600)] = 10.0

    def change(self, world: World, rng: np.random.Generator) -> World:
        """Return the world under this light, which moves if ``start`` and ``end`` differ."""
        sky_at = partial(_sky, self, int(rng.integers(2**63)))
        return replace(world, sky=sky_at(0.0), sky_at=None if self.start == self.end else sky_at)

    def share_at(self, time_s: float) -> float:
        """Return the share of the way from noon to dusk."""
        passed = min(max(time_s / self.over_s, 0.0), 1.0)
        return self.start + (self.end - self.start) * passed


def daylight(share: float) -> Daylight:
    """Return the light at a share of the way from noon to dusk."""
    return Daylight(
        *(
            (1 - share) * getattr(NOON, field.name) + share * getattr(DUSK, field.name)
            for field in fields(Daylight)
        )
    )


def _sky(evening: Evening, seed: int, time_s: float) -> Sky:
    return sunny_sky(daylight(evening.share_at(time_s)), np.random.default_rng(seed))
