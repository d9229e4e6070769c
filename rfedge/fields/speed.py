"""What a frame of a field takes on this machine."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from rfcore.camera import Camera
from rfcore.field import FULL, Quality, RadianceField
from rfedge.bench.timing import median_ms

__all__ = ["frame_ms"]


def frame_ms(
    field: RadianceField, cameras: Sequence[Camera], quality: Quality = FULL, rounds: int = 3
) -> float:
    """Return the median time of a frame over ``rounds`` turns through ``cameras``."""
    field.prepare(quality)
    turns = itertools.cycle(cameras)
    return median_ms(
        lambda: field.render_colour(next(turns), quality), repetitions=rounds * len(cameras)
    )
