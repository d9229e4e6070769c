"""Describe vehicle bodies by curves over their length, as side and plan views give them.

Stations run from the nose (0) to the tail (``length_m``), heights from the road, both in metres.
Between the knots curves are monotone cubics (Fritsch and Butland 1984), so that they do not
overshoot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from rfcore.errors import InvalidInput
from streetgen.geometry.mesh import F64

Knots = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class BodyShape:
    """The shape of one body.

    ``top`` is the middle line over bonnet, windscreen, roof and tail, ``belt`` the lower edge of
    the side windows, ``width`` half the width as a share of the widest. ``axles_m`` are stations.
    ``windscreen``, ``rear_window`` and ``side_windows`` are ranges of stations with glass,
    ``doors`` the stations of the gaps. ``bow_m`` is how far nose and tail stand out in the middle.
    With ``cladding`` sills and bumpers are of dark plastic.
    """

    length_m: float
    width_m: float
    axles_m: tuple[float, ...]
    wheel_radius_m: float
    sill_m: float
    top: Knots
    belt: Knots
    width: Knots
    windscreen: tuple[float, float]
    rear_window: tuple[float, float] | None
    side_windows: tuple[tuple[float, float], ...]
    doors: tuple[float, ...]
    bow_m: tuple[float, float] = (0.16, 0.08)
    lean: float = 0.34
    cladding: bool = False

    def __post_init__(self) -> None:
        for name in ("top", "belt", "width"):
            stations = [station for station, _ in getattr(self, name)]
            if any(b <= a for a, b in pairwise(stations)):
                raise InvalidInput(f"body.{name}", f"stations {stations} do not grow")

    @property
    def arch_radius_m(self) -> float:
        """Radius of the wheel arches."""
        return self.wheel_radius_m + 0.045


def curve(knots: Knots, at: ArrayLike) -> F64:
    """Evaluate a monotone cubic through the knots; constant beyond the ends."""
    (first, _), (last, _) = knots[0], knots[-1]
    return np.asarray(_spline(knots)(np.clip(np.asarray(at, np.float64), first, last)))


@lru_cache(maxsize=64)
def _spline(knots: Knots) -> Callable[[F64], F64]:
    """Return SciPy's monotone cubic with the slope of the first and last segment at the ends.

    ``PchipInterpolator`` itself ends with three-point slopes, which would bend noses and tails.
    """
    x, y = np.array(knots, np.float64).T
    slopes = PchipInterpolator(x, y).derivative()(x)
    segments = np.diff(y) / np.diff(x)
    slopes[0], slopes[-1] = segments[0], segments[-1]
    spline: Callable[[F64], F64] = CubicHermiteSpline(x, y, slopes)
    return spline


HATCHBACK = BodyShape(
    length_m=4.26,
    width_m=1.79,
    axles_m=(0.86, 3.48),
    wheel_radius_m=0.316,
    sill_m=0.20,
    top=(
        *((0.0, 0.70), (0.15, 0.76), (0.45, 0.86), (1.05, 0.98), (1.75, 1.38), (2.05, 1.455)),
        *((2.5, 1.48), (3.2, 1.465), (3.78, 1.40), (4.05, 1.08), (4.14, 0.99), (4.26, 0.96)),
    ),
    belt=(
        (0.0, 0.66),
        (0.4, 0.79),
        (1.0, 0.88),
        (1.8, 0.91),
        (3.2, 0.96),
        (3.9, 1.01),
        (4.26, 0.94),
    ),
    width=(
        (0.0, 0.84),
        (0.3, 0.93),
        (0.8, 0.985),
        (1.4, 1.0),
        (3.3, 1.0),
        (3.9, 0.95),
        (4.26, 0.87),
    ),
    windscreen=(1.08, 1.86),
    rear_window=(3.80, 4.06),
    side_windows=((1.42, 2.34), (2.42, 3.22), (3.27, 3.60)),
    doors=(1.30, 2.38, 3.30),
)
SALOON = BodyShape(
    length_m=4.72,
    width_m=1.83,
    axles_m=(0.88, 3.68),
    wheel_radius_m=0.325,
    sill_m=0.19,
    top=(
        *((0.0, 0.66), (0.15, 0.74), (0.5, 0.85), (1.2, 0.96), (1.95, 1.345), (2.3, 1.425)),
        *(
            (2.7, 1.44),
            (3.2, 1.40),
            (3.65, 1.27),
            (4.12, 1.05),
            (4.3, 1.03),
            (4.58, 1.03),
            (4.72, 0.98),
        ),
    ),
    belt=(
        (0.0, 0.63),
        (0.4, 0.77),
        (1.2, 0.87),
        (2.0, 0.90),
        (3.4, 0.95),
        (4.2, 0.97),
        (4.72, 0.92),
    ),
    width=(
        (0.0, 0.83),
        (0.3, 0.93),
        (0.9, 0.985),
        (1.5, 1.0),
        (3.6, 1.0),
        (4.3, 0.96),
        (4.72, 0.87),
    ),
    windscreen=(1.24, 2.08),
    rear_window=(3.32, 4.06),
    side_windows=((1.60, 2.52), (2.60, 3.42)),
    doors=(1.42, 2.56, 3.50),
)
ESTATE = BodyShape(
    length_m=4.68,
    width_m=1.82,
    axles_m=(0.90, 3.60),
    wheel_radius_m=0.325,
    sill_m=0.20,
    top=(
        *((0.0, 0.68), (0.15, 0.76), (0.5, 0.86), (1.15, 0.98), (1.88, 1.38), (2.2, 1.455)),
        *((2.7, 1.48), (3.6, 1.46), (4.22, 1.40), (4.46, 1.10), (4.56, 1.0), (4.68, 0.96)),
    ),
    belt=(
        (0.0, 0.65),
        (0.4, 0.79),
        (1.1, 0.89),
        (2.0, 0.92),
        (3.4, 0.95),
        (4.3, 1.0),
        (4.68, 0.94),
    ),
    width=(
        (0.0, 0.84),
        (0.3, 0.93),
        (0.9, 0.985),
        (1.5, 1.0),
        (3.7, 1.0),
        (4.3, 0.96),
        (4.68, 0.88),
    ),
    windscreen=(1.18, 2.0),
    rear_window=(4.24, 4.47),
    side_windows=((1.55, 2.46), (2.54, 3.40), (3.47, 4.08)),
    doors=(1.40, 2.50, 3.46),
)
SUV = BodyShape(
    length_m=4.48,
    width_m=1.86,
    axles_m=(0.90, 3.58),
    wheel_radius_m=0.36,
    sill_m=0.27,
    top=(
        *((0.0, 0.86), (0.12, 0.93), (0.45, 1.03), (1.1, 1.12), (1.72, 1.53), (2.05, 1.63)),
        *((2.6, 1.66), (3.5, 1.64), (4.08, 1.56), (4.30, 1.22), (4.38, 1.12), (4.48, 1.08)),
    ),
    belt=(
        (0.0, 0.82),
        (0.4, 0.96),
        (1.0, 1.03),
        (1.8, 1.06),
        (3.3, 1.10),
        (4.1, 1.16),
        (4.48, 1.06),
    ),
    width=(
        (0.0, 0.86),
        (0.3, 0.95),
        (0.8, 0.99),
        (1.4, 1.0),
        (3.6, 1.0),
        (4.1, 0.96),
        (4.48, 0.90),
    ),
    windscreen=(1.13, 1.84),
    rear_window=(4.10, 4.30),
    side_windows=((1.45, 2.36), (2.44, 3.28), (3.34, 3.86)),
    doors=(1.34, 2.40, 3.36),
    cladding=True,
)
VAN = BodyShape(
    length_m=5.55,
    width_m=2.02,
    axles_m=(0.98, 4.32),
    wheel_radius_m=0.345,
    sill_m=0.26,
    top=(
        *((0.0, 0.98), (0.12, 1.05), (0.35, 1.13), (0.78, 1.24), (1.42, 1.98), (1.75, 2.24)),
        *((2.3, 2.36), (3.2, 2.39), (5.2, 2.37), (5.46, 2.33), (5.55, 2.25)),
    ),
    belt=((0.0, 0.92), (0.35, 1.02), (0.8, 1.13), (1.6, 1.19), (2.4, 1.22), (5.55, 1.22)),
    width=((0.0, 0.85), (0.3, 0.94), (0.8, 0.985), (1.4, 1.0), (5.2, 1.0), (5.55, 0.985)),
    windscreen=(0.84, 1.52),
    rear_window=None,
    side_windows=((1.15, 2.06),),
    doors=(1.08, 2.14, 3.42),
    bow_m=(0.18, 0.015),
    lean=0.10,
    cladding=True,
)
CAB = BodyShape(
    length_m=1.95,
    width_m=2.2,
    axles_m=(0.98,),
    wheel_radius_m=0.42,
    sill_m=0.42,
    top=(
        (0.0, 1.10),
        (0.1, 1.20),
        (0.22, 1.32),
        (0.55, 2.12),
        (0.8, 2.36),
        (1.3, 2.44),
        (1.95, 2.46),
    ),
    belt=((0.0, 1.02), (0.2, 1.2), (0.5, 1.30), (1.95, 1.34)),
    width=((0.0, 0.90), (0.25, 0.97), (0.6, 1.0), (1.95, 1.0)),
    windscreen=(0.24, 0.66),
    rear_window=None,
    side_windows=((0.48, 1.42),),
    doors=(0.42, 1.52),
    bow_m=(0.14, 0.0),
    lean=0.10,
    cladding=True,
)
BODIES = {
    "hatchback": HATCHBACK,
    "saloon": SALOON,
    "estate": ESTATE,
    "suv": SUV,
    "van": VAN,
    "cab": CAB,
}
