"""Per-picture exposure: one affine map of colours [3, 4] a picture, learned with the field.

Only for datasets that declare it. The maps' mean over the pictures is kept at "no change", so the
field itself shows the mean picture and is rendered without any map.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rfcore.raster.trainable import Exposure

__all__ = ["ExposureModel"]

F64 = NDArray[np.float64]
RATE = 3e-3
"""Adam's, at the start of the run: a stop of exposure within some hundred visits."""
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-12
NO_CHANGE = np.eye(3, 4)


class ExposureModel:
    """The maps of one run; a picture's moves when the picture is visited."""

    def __init__(self, views: int) -> None:
        self._maps = np.tile(NO_CHANGE, (views, 1, 1))
        self._first, self._second = np.zeros_like(self._maps), np.zeros_like(self._maps)
        self._visits = np.zeros(views)

    def of_view(self, view: int) -> Exposure:
        """Return the map of a picture, with room for its gradient."""
        affine = self._maps[view] - self._maps.mean(axis=0) + NO_CHANGE
        return Exposure(np.ascontiguousarray(affine, np.float32), np.zeros((3, 4)))

    def step(self, view: int, gradient: F64, factor: float) -> None:
        """Do one step of Adam at ``factor`` times the rate."""
        self._visits[view] += 1
        first, second = self._first[view], self._second[view]
        first += (1 - BETA1) * (gradient - first)
        second += (1 - BETA2) * (gradient * gradient - second)
        # Multiplied out: two C libraries' pow() need not agree.
        powers = np.multiply.reduce(np.tile([BETA1, BETA2], (int(self._visits[view]), 1)))
        mean, square = first / (1 - powers[0]), second / (1 - powers[1])
        self._maps[view] -= RATE * factor * mean / (np.sqrt(square) + EPSILON)

    def arrays(self) -> dict[str, F64]:
        """Return what ``restore`` goes on from."""
        parts = {"maps": self._maps, "first": self._first, "second": self._second}
        copies = {f"exposure.{name}": array.copy() for name, array in parts.items()}
        return copies | {"exposure.visits": self._visits.copy()}

    def restore(self, arrays: Mapping[str, F64]) -> None:
        """Go on from ``arrays``."""
        self._maps = arrays["exposure.maps"].copy()
        self._first = arrays["exposure.first"].copy()
        self._second = arrays["exposure.second"].copy()
        self._visits = arrays["exposure.visits"].copy()
