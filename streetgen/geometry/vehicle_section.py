"""Loft a surface through the cross-sections of a vehicle body at its stations.

A half section runs from the sill up over the belt and the roof's edge to the middle of the top; its
rows mean the same at every station, so that windows, lamps and mouldings end exactly on rows and
columns and have no ragged edges. Where the body is cut out for a wheel, the sill rises in an arch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from streetgen.geometry.mesh import F64
from streetgen.geometry.vehicle_shape import BodyShape, curve

END_M = 0.10
"""Radius of the rounded edge between the sides and nose or tail."""
FILLET_RINGS = 4
SEAM_M = 0.008
CROWN_M = 0.05
BELOW = (0.0, 0.05, 0.13, 0.22, 0.34, 0.46, 0.57, 0.62, 0.70, 0.78, 0.88, 0.95, 1.0)
"""Rows between sill and belt, as shares of the height."""
BESIDE = (0.035, 0.075, 0.12, 0.32, 0.54, 0.76, 0.92, 1.0)
"""Rows between belt and the roof's edge."""
ABOVE = (0.95, 0.86, 0.62, 0.32, 0.0)
"""Rows over the top, as shares of its half width."""


class Rows:
    """Numbers of rows in a half section."""

    SILL_TOP = 2
    GRILLE_LOW, GRILLE_HIGH = 3, 5
    LAMP_LOW, LAMP_HIGH = 7, 11
    BELT = len(BELOW) - 1
    TRIM_TOP = BELT + 1
    GLASS_LOW, GLASS_HIGH = BELT + 2, BELT + 7
    EDGE = BELT + len(BESIDE)
    SCREEN = EDGE + 1
    MIDDLE = EDGE + len(ABOVE)


@dataclass(frozen=True, eq=False)
class Lofted:
    """``points`` [S, 2 M + 1, 3] from the right sill over the top to the left one, nose to tail.

    ``at`` [S] are the stations that the columns belong to; the rounded ends repeat the outermost.
    """

    points: F64
    at: F64


def stations(shape: BodyShape) -> F64:
    """Return where sections are taken: evenly, densely at arches, and at every edge."""
    even = np.linspace(END_M, shape.length_m - END_M, int(shape.length_m / 0.11))
    turn = np.cos(np.linspace(0, np.pi, 17))
    arches = [axle + shape.arch_radius_m * turn for axle in shape.axles_m]
    edges = [value for span in shape.side_windows for value in span]
    edges += [value for span in (shape.windscreen, shape.rear_window) if span for value in span]
    edges += [door + side * SEAM_M / 2 for door in shape.doors for side in (-1, 1)]
    fixed = np.concatenate([*arches, np.array(edges), [END_M, shape.length_m - END_M]])
    near = np.abs(even[:, None] - fixed[None]).min(axis=1) < 0.025
    return np.unique(np.concatenate([even[~near], fixed]).round(5))


def sill_line(shape: BodyShape, at: F64) -> F64:
    """Return the height of the body's lower edge, over the wheels an arch."""
    ends = np.minimum(at, shape.length_m - at)
    low = shape.sill_m + 0.07 * np.clip(1 - ends / 0.5, 0, 1) ** 2
    for axle in shape.axles_m:
        inside = np.maximum(shape.arch_radius_m**2 - (at - axle) ** 2, 0.0)
        low = np.where(inside > 0, np.maximum(shape.wheel_radius_m + np.sqrt(inside), low), low)
    return np.asarray(low)


def lofted(shape: BodyShape) -> Lofted:
    """Return the surface of a body without its ends' faces, in the vehicle's frame.

    x points forward from the middle of the length, y to the left, z up from the road.
    """
    at = stations(shape)
    half = np.stack([_half_section(shape, station) for station in at])
    nose = _rounded(half[0])
    tail = _rounded(half[-1])
    x = np.concatenate([END_M - nose[1][::-1], at, shape.length_m - END_M + tail[1]])
    half = np.concatenate([nose[0][::-1], half, tail[0]])
    left = np.stack([np.broadcast_to(x[:, None], half.shape[:2]), half[..., 0], half[..., 1]], 2)
    right = left * (1, -1, 1)
    points = np.concatenate([right, left[:, -2::-1]], axis=1)
    repeated = np.concatenate([[at[0]] * FILLET_RINGS, at, [at[-1]] * FILLET_RINGS])
    return Lofted(_bowed(shape, points), repeated)


def _half_section(shape: BodyShape, station: float) -> F64:
    """Return the section at a station as points [M + 1, 2] of (half width, height)."""
    low = float(sill_line(shape, np.array(station)))
    top = float(curve(shape.top, station))
    widest = 0.5 * shape.width_m * float(curve(shape.width, station))
    belt = min(float(curve(shape.belt, station)), top - CROWN_M - 0.03)
    edge = top - CROWN_M
    height = np.concatenate(
        [
            low + (belt - low) * np.array(BELOW),
            belt + (edge - belt) * np.array(BESIDE),
            edge + CROWN_M * (1 - np.array(ABOVE) ** 2.2),
        ]
    )
    across = widest * _bulge((height[: len(BELOW)] - shape.sill_m) / (belt - shape.sill_m))
    share = np.array(BESIDE)
    leaning = shape.lean * (edge - belt)
    shoulder = 0.018 + 0.05 * np.exp(-(edge - belt) / 0.06)
    beside = across[-1] - shoulder * np.minimum(share / 0.12, 1) - leaning * share**1.25
    rounding = 0.03 * np.clip((share - 0.85) / 0.15, 0, 1)
    above = (beside[-1] - rounding[-1]) * np.array(ABOVE)
    return np.stack([np.concatenate([across, beside - rounding, above]), height], axis=1)


def _bulge(share: F64) -> F64:
    """Return the half width over the height from sill to belt, with a shoulder line."""
    knots = ((-0.3, 0.93), (0.0, 0.955), (0.2, 0.985), (0.45, 0.998), (0.62, 1.0), (0.70, 0.984))
    return curve((*knots, (0.85, 0.975), (1.0, 0.955)), share)


def _rounded(section: F64) -> tuple[F64, F64]:
    """Return rings [R, M + 1, 2] that close in on a face, and how far each stands out [R]."""
    turn = np.linspace(0, np.pi / 2, FILLET_RINGS + 1)[1:]
    inwards = END_M * (1 - np.cos(turn))
    middle = 0.5 * (section[0, 1] + section[-1, 1])
    reach = 0.5 * (section[-1, 1] - section[0, 1])
    rings = np.repeat(section[None], FILLET_RINGS, axis=0)
    rings[..., 0] *= 1 - inwards[:, None] / section[:, 0].max()
    rings[..., 1] = middle + (section[:, 1] - middle) * (1 - 0.6 * inwards[:, None] / reach)
    return rings, END_M * np.sin(turn)


def _bowed(shape: BodyShape, points: F64) -> F64:
    """Turn stations into forward x, and bend nose and tail out in the middle."""
    station, y, z = np.moveaxis(points, 2, 0)
    across = 1 - (y / (0.5 * shape.width_m)) ** 2
    bumper = np.exp(-(((z - 0.2 - 0.5 * shape.sill_m) / 0.22) ** 2))
    front, rear = shape.bow_m
    near_nose = np.clip(1 - station / 1.3, 0, 1) ** 2
    near_tail = np.clip(1 - (shape.length_m - station) / 0.7, 0, 1) ** 2
    out = near_nose * (front * (across - 1) + 0.05 * (bumper - 1))
    back = near_tail * (rear * (across - 1) + 0.04 * (bumper - 1))
    x = 0.5 * shape.length_m - station + out - back
    return np.stack([x, y, z], axis=2)
