"""Thin things over the street: lamp posts with arms, wires between them and across, railings."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rfedge.street.geometry.layout import FACADE_M, SIDES, Layout, Place
from rfedge.street.geometry.material import Material
from rfedge.street.geometry.mesh import Label, Mesh
from rfedge.street.geometry.solids import Stuff, boxes, disc, tube
from rfedge.street.geometry.world import Part

__all__ = ["lamps", "railings", "wires"]

POST = Stuff("post", Label.POLE)
SHADE = Stuff("shade", Label.POLE)
WIRE = Stuff("wire", Label.WIRE)
RAIL = Stuff("rail", Label.POLE)
POST_PAINT = Material("post", (0.05, 0.055, 0.055), roughness=0.4, metallic=0.3)
POST_UP_M = 7.0
WIRE_RADIUS_M = 0.011
WIRE_HEIGHTS_M = (6.6, 6.9)
SAG_M = 0.5
SPAN_UP_M = 8.1


def lamps(layout: Layout, _rng: np.random.Generator) -> Part:
    """Return posts, each with an arm over the road and a lamp at its end."""
    meshes = [mesh for place in layout.lamps for mesh in _lamp(place)]
    return Part(tuple(meshes), (POST_PAINT, Material("shade", (0.8, 0.8, 0.78), gloss=True)))


def wires(layout: Layout, _rng: np.random.Generator) -> Part:
    """Return two wires along each row of lamps, spans across every 48 m, and two over the lanes."""
    meshes: list[Mesh] = []
    for side in SIDES:
        row = sorted(place.x_m for place in layout.lamps if place.side == side)
        y = side * layout.lamps[0].y_m * layout.lamps[0].side
        for start, end in pairwise(row):
            share = np.linspace(0, 1, 20)
            for height in WIRE_HEIGHTS_M:
                z = height - 4 * SAG_M * share * (1 - share)
                meshes.append(_wire(start + (end - start) * share, y, z))
    across = np.linspace(-FACADE_M, FACADE_M, 24)
    span_z = SPAN_UP_M + 0.15 + 0.7 * (across / FACADE_M) ** 2
    spans = [place.x_m for place in layout.lamps if place.side > 0][::2]
    meshes += [_wire(x, across, span_z) for x in spans]
    along = np.arange(layout.start_m, layout.end_m, 4.0)
    for y_m in (1.9, -1.9):
        sway = 0.2 * np.cos(along / 48.0 * 2 * np.pi)
        meshes.append(_wire(along, y_m, SPAN_UP_M - 0.1 + sway))
    return Part(tuple(meshes), (Material("wire", (0.02, 0.02, 0.02)),))


def railings(layout: Layout, rng: np.random.Generator) -> Part:
    """Return a railing of thin bars by each crossing and a row of bollards after it."""
    meshes: list[Mesh] = []
    for crossing in layout.crossings_x_m:
        for side in SIDES:
            meshes += _railing(crossing + 2.5 + rng.uniform(0, 0.5), side)
            meshes += _bollards(crossing - 10.0, side)
    rail = Material("rail", (0.5, 0.51, 0.52), roughness=0.35, metallic=0.9)
    return Part(tuple(meshes), (rail, POST_PAINT))


def _lamp(place: Place) -> list[Mesh]:
    x, y, side = place.x_m, place.y_m, place.side
    foot = tube(
        POST, [(x, y, 0.1), (x, y, 0.8), (x, y, 0.81), (x, y, POST_UP_M)], (0.12, 0.11, 0.07, 0.05)
    )
    bend = np.linspace(0, np.pi / 2, 8)
    reach = y - side * 1.8 * (1 - np.cos(bend))
    arm = tube(POST, np.stack([x + 0 * bend, reach, POST_UP_M + np.sin(bend)], axis=1), 0.035, 8)
    end = y - side * 2.2
    head = boxes(POST, (x - 0.14, end - 0.35, 7.93), (x + 0.14, end + 0.35, 8.06))
    glass = boxes(SHADE, (x - 0.11, end - 0.3, 7.9), (x + 0.11, end + 0.3, 7.93))
    return [foot, arm, head, glass]


def _wire(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> Mesh:
    return tube(WIRE, np.stack(np.broadcast_arrays(x, y, z), axis=1), WIRE_RADIUS_M, 5)


def _railing(start: float, side: int) -> list[Mesh]:
    bars, y = start + 0.15 * np.arange(50), side * 7.05
    ones = np.ones_like(bars)
    low = np.stack([bars - 0.01, (y - 0.01) * ones, 0.14 * ones], axis=1)
    upright = boxes(RAIL, low, low + np.array([0.02, 0.02, 1.0]))
    end = bars[-1] + 0.1
    rails = boxes(
        RAIL,
        [(start - 0.1, y - 0.025, 1.13), (start - 0.1, y - 0.02, 0.3)],
        [(end, y + 0.025, 1.18), (end, y + 0.02, 0.34)],
    )
    return [upright, rails]


def _bollards(start: float, side: int) -> list[Mesh]:
    meshes = []
    for i in range(5):
        x, y = start + 1.4 * i, side * 7.05
        meshes.append(tube(POST, [(x, y, 0.1), (x, y, 0.95)], 0.05))
        meshes.append(disc(POST, (x, y, 0.95), (0, 0, 1), 0.05, 10))
    return meshes
