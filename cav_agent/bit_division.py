"""How the bytes of an instant are divided among the cameras of a rig, so that quality is even.

A slice of complexity c takes about c 2^(-CRF / 6) bytes. So all cameras come out at one CRF when
each gets bytes in proportion to its complexity, which is learnt from its coded frames. Motion, a
field that shows something else than the camera sees, and a mask that is coded finer make slices
longer at the same CRF: they are in the complexity. ``priority`` weighs it: a camera of priority 2
gets twice the bytes of its like.

The shares sum to the budget, and none is below ``LEAST_SHARE`` of an even share: a camera that
shows little now is ready for what comes next. Without clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rfcore.errors import InvalidInput

__all__ = ["LEAST_SHARE", "BitDivision"]

LEAST_SHARE = 0.25
"""Of an even share, what every camera gets at least."""

HALVING_CRF = 6.0
"""CRF that halves a slice (4 of CRF change the bits of a street by 60 %)."""

MEMORY = 0.75
"""Weight of what was known of a camera's complexity, when a frame was coded."""


class BitDivision:
    """Divides bytes among cameras by complexity and ``priorities``."""

    def __init__(self, priorities: Mapping[str, float]) -> None:
        for camera_id, priority in priorities.items():
            if not (math.isfinite(priority) and priority > 0):
                raise InvalidInput("priority", f"{priority} of camera {camera_id} must be above 0")
        self._priorities = dict(priorities)
        self._complexity: dict[str, float] = {}

    def coded(self, camera_id: str, payload_bytes: int, crf: float) -> None:
        """A frame of a camera took so many bytes at ``crf``."""
        found = max(1, payload_bytes) * 2 ** (crf / HALVING_CRF)
        known = self._complexity.get(camera_id, found)
        self._complexity[camera_id] = MEMORY * known + (1 - MEMORY) * found

    def divide(self, total_bytes: float, camera_ids: Sequence[str]) -> dict[str, float]:
        """Return the bytes of each camera; they sum to ``total_bytes``.

        A camera of which nothing was coded yet counts as complex as the mean of the others.
        """
        known = [self._complexity[c] for c in camera_ids if c in self._complexity]
        usual = sum(known) / len(known) if known else 1.0
        weights = {
            c: self._priorities.get(c, 1.0) * self._complexity.get(c, usual) for c in camera_ids
        }
        whole, least = sum(weights.values()), LEAST_SHARE / len(camera_ids)
        return {
            c: total_bytes * (least + (1 - LEAST_SHARE) * weight / whole)
            for c, weight in weights.items()
        }
