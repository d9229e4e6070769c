"""Noticing that a run has left the ground.

A run that learns has a falling mean loss over ``WINDOW`` iterations. One whose mean rises above
half as much again as its lowest, and above where it began, has diverged; the group of parameters
whose size grew most since the first window is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from rfcore.errors import TrainingDiverged

__all__ = ["WINDOW", "DivergenceWatch"]

WINDOW = 100
TOLERATED_RISE = 1.5


class DivergenceWatch:
    """Follows the loss of one run."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._first: float | None = None
        self._lowest = math.inf
        self._sizes: dict[str, float] = {}

    def see(self, iteration: int, loss: float, parameters: Callable[[], Any]) -> None:
        """Take the loss of one iteration; raise ``TrainingDiverged`` if the run is lost."""
        if not math.isfinite(loss):
            raise TrainingDiverged(iteration, self._grown(parameters()), f"the loss is {loss}")
        self._sum += loss
        if iteration % WINDOW:
            return
        mean, self._sum = self._sum / WINDOW, 0.0
        if self._first is None:
            self._first, self._sizes = mean, _sizes(parameters())
        self._lowest = min(self._lowest, mean)
        if mean > max(TOLERATED_RISE * self._lowest, self._first):
            raise TrainingDiverged(
                iteration,
                self._grown(parameters()),
                f"a mean loss of {mean:.3g} after {self._lowest:.3g}; lower the group's rate",
            )

    def values(self) -> dict[str, Any]:
        """Return what ``restore`` needs, as JSON."""
        lowest = self._lowest if math.isfinite(self._lowest) else None
        return {"sum": self._sum, "first": self._first, "lowest": lowest, "sizes": self._sizes}

    def restore(self, values: dict[str, Any]) -> None:
        """Go on from ``values``."""
        self._sum, self._first = values["sum"], values["first"]
        self._lowest = math.inf if values["lowest"] is None else values["lowest"]
        self._sizes = values["sizes"]

    def _grown(self, parameters: Any) -> str:
        growth = {
            name: size / max(self._sizes.get(name, size), 1e-9)
            for name, size in _sizes(parameters).items()
        }
        return max(growth, key=lambda name: growth[name])


def _sizes(parameters: Any) -> dict[str, float]:
    """Return the root of the mean square of every group, the arrays of a dataclass."""
    arrays = {f.name: getattr(parameters, f.name) for f in fields(parameters)}
    return {
        name: float(np.sqrt(np.mean(np.square(array, dtype=np.float64)))) if array.size else 0.0
        for name, array in arrays.items()
    }
