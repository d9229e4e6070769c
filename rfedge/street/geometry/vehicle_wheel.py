"""Wheels: a tyre with shoulders, a rim with spokes in front of a brake disc."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rfedge.street.geometry.mesh import F64, Label, Mesh, placed
from rfedge.street.geometry.solids import Stuff, disc, quads

__all__ = ["revolved", "wheel"]

SIDES = 32
TYRE = Stuff("tyre", Label.VEHICLE)
RIM = Stuff("rim", Label.VEHICLE)
DARK = Stuff("car gap", Label.VEHICLE)
BRAKE = Stuff("brake disc", Label.VEHICLE)
TYRE_PROFILE = (
    *((0.66, 0.42), (0.70, 0.47), (0.80, 0.5), (0.92, 0.49), (0.985, 0.43), (1.0, 0.36)),
    *((1.0, -0.36), (0.985, -0.43), (0.92, -0.49), (0.70, -0.47), (0.66, -0.42)),
)
"""Radius over the wheel's, place across over the tyre's width; outside first."""
RIM_PROFILE = ((0.67, 0.44), (0.645, 0.445), (0.62, 0.40), (0.60, 0.1))
RIM_RADIUS, HUB_RADIUS = 0.63, 0.17
SPOKE_OUT = (0.34, 0.40)
"""Where the spokes' faces are across the width: at the hub and at the rim."""


def wheel(radius_m: float, width_m: float, spokes: int, outside: int) -> list[Mesh]:
    """Return a wheel about the y axis with its middle at the origin; ``outside`` is +1 or -1."""
    parts = [
        revolved(TYRE, np.array(TYRE_PROFILE) * (radius_m, width_m), SIDES),
        revolved(RIM, np.array(RIM_PROFILE) * (radius_m, width_m), SIDES),
        disc(DARK, (0, 0.02 * width_m, 0), (0, 1, 0), 0.61 * radius_m, SIDES),
        disc(BRAKE, (0, 0.10 * width_m, 0), (0, 1, 0), 0.45 * radius_m, 20),
        _spokes(radius_m, width_m, spokes),
        disc(RIM, (0, 0.36 * width_m, 0), (0, 1, 0), HUB_RADIUS * radius_m, 16),
    ]
    turned = np.diag([float(outside), float(outside), 1.0, 1.0])
    return [placed(part, turned) for part in parts]


def revolved(stuff: Stuff, profile: ArrayLike, sides: int) -> Mesh:
    """Return the surface of a profile [N, 2] of (radius, y) turned about the y axis, smooth.

    Seen from outside the profile runs from the +y end to the -y end.
    """
    points = np.asarray(profile, np.float64)
    along = np.gradient(points, axis=0)
    out = np.stack([-along[:, 1], along[:, 0]], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    rows, columns = len(points), sides + 1
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(sides)[None]).reshape(-1)
    corners = np.stack([first, first + columns, first + columns + 1, first + 1], axis=1)
    uv = np.stack(np.broadcast_arrays(turn[None] / (2 * np.pi), points[:, 1:]), axis=-1)
    return Mesh(
        vertices=_about_y(points, turn).astype(np.float32),
        faces=corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32),
        uv=np.ascontiguousarray(uv.reshape(-1, 2), np.float32),
        material=stuff.material,
        label=stuff.label,
        normals=_about_y(out, turn).astype(np.float32),
    )


def _about_y(pairs: F64, turn: F64) -> F64:
    """Turn (radius, y) [N, 2] into [N T, 3]."""
    x, z = (pairs[:, :1] * trig[None] for trig in (np.sin(turn), np.cos(turn)))
    y = np.broadcast_to(pairs[:, 1:], x.shape)
    return np.stack([x, y, z], axis=2).reshape(-1, 3)


def _spokes(radius_m: float, width_m: float, count: int) -> Mesh:
    """Bars from hub to rim: a face and two flanks each."""
    half = 0.055 * radius_m * 10 / max(count, 6)
    inner, outer = (HUB_RADIUS - 0.02) * radius_m, RIM_RADIUS * radius_m
    hub_y, rim_y, back_y = SPOKE_OUT[0] * width_m, SPOKE_OUT[1] * width_m, 0.12 * width_m
    face = [(inner, hub_y, 1.25), (inner, hub_y, -1.25), (outer, rim_y, -0.8), (outer, rim_y, 0.8)]
    sides = []
    for sign in (1.0, -1.0):
        near, far = 1.25 * sign, 0.8 * sign
        flank = [(inner, hub_y, near), (outer, rim_y, far), (outer, back_y, far)]
        flank.append((inner, back_y, near))
        sides.append(flank if sign > 0 else flank[::-1])
    bar = np.array([face, *sides]) * (1.0, 1.0, half)
    turn = 2 * np.pi * np.arange(count) / count
    x = (
        bar[None, ..., 0] * np.cos(turn)[:, None, None]
        - bar[None, ..., 2] * np.sin(turn)[:, None, None]
    )
    z = (
        bar[None, ..., 0] * np.sin(turn)[:, None, None]
        + bar[None, ..., 2] * np.cos(turn)[:, None, None]
    )
    y = np.broadcast_to(bar[None, ..., 1], x.shape)
    return quads(RIM, np.stack([x, y, z], axis=-1).reshape(-1, 4, 3))
