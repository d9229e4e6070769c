"""Make street furniture: lamp posts, wires, railings, bollards, traffic signs and lights.

Each sign has its own post at one of the layout's places and faces oncoming drivers. Traffic lights
stand before the crossings, one at the pavement and one on an arm over the lane.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.layout import PAVEMENT_UP_M, SIDES, GroundSpot, Layout
from streetgen.geometry.mesh import F32, F64, Material, Mesh, placed
from streetgen.geometry.signage import FACES, NAMES, ROUND, face_uv, name_uv, sign_materials
from streetgen.geometry.solids import Surface, boxes, disc, quads, tube
from streetgen.geometry.world import StreetPart

LAMP_POST = Surface("post", Label.POLE)
SHADE = Surface("shade", Label.POLE)
WIRE = Surface("wire", Label.WIRE)
RAIL = Surface("rail", Label.POLE)
POST_PAINT = Material("post", (0.05, 0.055, 0.055), roughness=0.4, metallic=0.3)
POST_UP_M = 7.0
WIRE_RADIUS_M = 0.011
WIRE_HEIGHTS_M = (6.6, 6.9)
SAG_M = 0.5
SPAN_UP_M = 8.1
RAIL_M = 7.05
"""Distance from the middle of the road to railings and bollards."""


def lamps(layout: Layout, _rng: np.random.Generator) -> StreetPart:
    """Return posts, each with an arm over the road and a lamp at its end."""
    meshes = [mesh for place in layout.lamps for mesh in _lamp(place)]
    return StreetPart(tuple(meshes), (POST_PAINT, Material("shade", (0.8, 0.8, 0.78), gloss=True)))


def wires(layout: Layout, _rng: np.random.Generator) -> StreetPart:
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
    across = np.linspace(-layout.facade_m, layout.facade_m, 24)
    span_z = SPAN_UP_M + 0.15 + 0.7 * (across / layout.facade_m) ** 2
    spans = [place.x_m for place in layout.lamps if place.side > 0][::2]
    meshes += [_wire(x, across, span_z) for x in spans]
    along = np.arange(layout.start_m, layout.end_m, 4.0)
    for y_m in (1.9, -1.9):
        sway = 0.2 * np.cos(along / 48.0 * 2 * np.pi)
        meshes.append(_wire(along, y_m, SPAN_UP_M - 0.1 + sway))
    return StreetPart(tuple(meshes), (Material("wire", (0.02, 0.02, 0.02)),))


def railings(layout: Layout, rng: np.random.Generator) -> StreetPart:
    """Return a railing of thin bars by each crossing and a row of bollards after it."""
    meshes: list[Mesh] = []
    for crossing in layout.crossings_x_m:
        for side in SIDES:
            y = side * (RAIL_M + layout.geometry.wider_m)
            meshes += _railing(crossing + 2.5 + rng.uniform(0, 0.5), y)
            meshes += _bollards(crossing - 10.0, y)
    rail = Material("rail", (0.5, 0.51, 0.52), roughness=0.35, metallic=0.9)
    return StreetPart(tuple(meshes), (rail, POST_PAINT))


def _lamp(place: GroundSpot) -> list[Mesh]:
    x, y, side = place.x_m, place.y_m, place.side
    foot = tube(
        LAMP_POST,
        [(x, y, 0.1), (x, y, 0.8), (x, y, 0.81), (x, y, POST_UP_M)],
        (0.12, 0.11, 0.07, 0.05),
    )
    bend = np.linspace(0, np.pi / 2, 8)
    reach = y - side * 1.8 * (1 - np.cos(bend))
    arm = tube(
        LAMP_POST, np.stack([x + 0 * bend, reach, POST_UP_M + np.sin(bend)], axis=1), 0.035, 8
    )
    end = y - side * 2.2
    head = boxes(LAMP_POST, (x - 0.14, end - 0.35, 7.93), (x + 0.14, end + 0.35, 8.06))
    glass = boxes(SHADE, (x - 0.11, end - 0.3, 7.9), (x + 0.11, end + 0.3, 7.93))
    return [foot, arm, head, glass]


def _wire(x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float) -> Mesh:
    return tube(WIRE, np.stack(np.broadcast_arrays(x, y, z), axis=1), WIRE_RADIUS_M, 5)


def _railing(start: float, y: float) -> list[Mesh]:
    bars = start + 0.15 * np.arange(50)
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


def _bollards(start: float, y: float) -> list[Mesh]:
    meshes = []
    for i in range(5):
        x = start + 1.4 * i
        meshes.append(tube(LAMP_POST, [(x, y, 0.1), (x, y, 0.95)], 0.05))
        meshes.append(disc(LAMP_POST, (x, y, 0.95), (0, 0, 1), 0.05, 10))
    return meshes


SIGN_POST = Surface("sign post", Label.POLE)
SIGN_BACK = Surface("sign back", Label.SIGN)
FACE = Surface("sign face", Label.SIGN)
NAME = Surface("street name", Label.SIGN)
CASE = Surface("signal case", Label.SIGN)
UNDER_M = 0.3
"""Depth under the pavement at which posts begin."""
FACE_M = 0.60
CENTRE_M = 2.45
LIGHT_OFFSET_M, LIGHT_M = 2.6, 6.95
"""Distances of traffic lights from the middle of a crossing and from the middle of the road."""
LENS_RADIUS_M = 0.10
CASE_HALF_M = np.array([0.06, 0.16, 0.46])
BOARD_M = np.array([0.012, 0.11, 0.14])
LENSES = ("signal red", "signal amber", "signal green")


def signs(layout: Layout, rng: np.random.Generator) -> StreetPart:
    """Return a sign at each of the layout's signposts, and lights at its crossings."""
    meshes: list[Mesh] = []
    for number, place in enumerate(layout.signposts):
        if not layout.at_crossing(place.x_m, 4.0):
            own = post_of(number, int(rng.integers(len(NAMES))))
            meshes += [placed(mesh, _facing(place)) for mesh in own]
    for crossing in layout.crossings_x_m:
        for side in SIDES:
            at = crossing + side * LIGHT_OFFSET_M
            heading = 0.0 if side > 0 else np.pi
            place = GroundSpot(
                at, side * (LIGHT_M + layout.geometry.wider_m), PAVEMENT_UP_M, side, heading
            )
            green = int(rng.integers(2)) * 2
            meshes += [placed(mesh, _facing(place)) for mesh in traffic_light(green)]
    return StreetPart(tuple(meshes), sign_materials())


def post_of(face: int, name: int) -> list[Mesh]:
    """Return a post with a sign, and every third with a street's name across above it.

    The foot is the origin of the pavement; the sign looks along x.
    """
    face %= len(FACES)
    named = face % 3 == 0
    top = CENTRE_M + 0.5 * FACE_M + (0.42 if named else 0.06)
    meshes = [_post(top, 0.032)]
    if FACES[face] in ROUND:
        meshes += _round_panel(face)
    else:
        meshes += _panel((FACE_M, FACE_M), CENTRE_M, FACE, face_uv(face))
    if named:
        meshes += _panel((1.15, 0.23), top - 0.12, NAME, name_uv(name))
    return meshes


def traffic_light(lit: int) -> list[Mesh]:
    """Return a post with a light at its side and one on an arm; ``lit`` 0 red, 1 amber, 2 green."""
    reach = np.array([(0, 0, 5.2), (0, -0.5, 5.55), (0, -2.0, 5.7), (0, -4.2, 5.75)])
    meshes = [_post(5.3, 0.075), tube(SIGN_POST, reach, (0.06, 0.055, 0.05, 0.045), 10)]
    for centre in (np.array([0.16, 0.0, 2.6]), np.array([0.14, -4.1, 5.35])):
        meshes += _lamp_case(centre, lit)
    hanger = [(0.10, -4.1, 5.75), (0.10, -4.1, 5.9)]
    return [
        *meshes,
        tube(SIGN_POST, hanger, 0.03, 8),
        tube(SIGN_POST, [(0, 0, 2.6), (0.12, 0, 2.6)], 0.03, 8),
    ]


def _post(top_m: float, radius_m: float) -> Mesh:
    return tube(SIGN_POST, [(0, 0, -UNDER_M), (0, 0, 1.0), (0, 0, top_m)], radius_m, 10)


def _panel(size_m: tuple[float, float], centre_m: float, front: Surface, uv: F32) -> list[Mesh]:
    """Return a sheet of metal clamped to the post, its picture towards x."""
    half_w, half_h = 0.5 * size_m[0], 0.5 * size_m[1]
    low, high = (0.036, -half_w, centre_m - half_h), (0.05, half_w, centre_m + half_h)
    clamp = boxes(SIGN_POST, (-0.036, -0.045, centre_m - 0.02), (0.036, 0.045, centre_m + 0.02))
    x, (y0, z0), (y1, z1) = 0.052, low[1:], high[1:]
    picture = quads(front, [[(x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1)]], uv[None])
    return [boxes(SIGN_BACK, low, high), clamp, picture]


def _round_panel(face: int) -> list[Mesh]:
    """Return a round sheet; the disc's picture is a row of the faces' texture."""
    clamp = boxes(SIGN_POST, (-0.036, -0.045, CENTRE_M - 0.02), (0.036, 0.045, CENTRE_M + 0.02))
    back = disc(SIGN_BACK, (0.04, 0, CENTRE_M), (-1, 0, 0), 0.5 * FACE_M, 32)
    front = disc(FACE, (0.05, 0, CENTRE_M), (1, 0, 0), 0.5 * FACE_M, 32)
    edge = np.array([(0.04, 0, CENTRE_M), (0.05, 0, CENTRE_M)])
    rim = tube(SIGN_BACK, edge, 0.5 * FACE_M, 32)
    low, high = face_uv(face)[2], face_uv(face)[0]
    u = high[0] + (low[0] - high[0]) * front.uv[:, :1]
    v = low[1] + (high[1] - low[1]) * front.uv[:, 1:]
    picture = replace(front, uv=np.concatenate([u, v], axis=1).astype(np.float32))
    return [clamp, back, rim, picture]


def _lamp_case(centre: F64, lit: int) -> list[Mesh]:
    """Return a case with three lenses under hoods, and its dark board behind."""
    meshes = [
        boxes(CASE, centre - CASE_HALF_M, centre + CASE_HALF_M),
        boxes(CASE, centre - CASE_HALF_M - BOARD_M, centre + CASE_HALF_M * (-1, 1, 1) + BOARD_M),
    ]
    for number, name in enumerate(LENSES):
        middle = centre + np.array([0.065, 0.0, 0.29 * (1 - number)])
        lens = Surface(name if number == lit else f"{name} off", Label.SIGN)
        meshes.append(disc(lens, middle, (1, 0, 0), LENS_RADIUS_M, 20))
        meshes.append(_hood(middle))
    return meshes


def _hood(middle: F64) -> Mesh:
    """Return half a tube over a lens, longer above."""
    turn = np.linspace(-0.15 * np.pi, 1.15 * np.pi, 13)
    radius = LENS_RADIUS_M + 0.012
    ring = np.stack([0 * turn, radius * np.cos(turn), radius * np.sin(turn)], axis=1) + middle
    out = ring + np.stack([0.07 + 0.06 * np.sin(turn).clip(0), 0 * turn, 0 * turn], axis=1)
    strips = [(ring[i], ring[j], out[j], out[i]) for i, j in pairwise(range(len(turn)))]
    return quads(CASE, np.array(strips))


def _facing(place: GroundSpot) -> F64:
    """Return world_from_sign: x points along the heading, the arm (-y) reaches over the road."""
    cos, sin = np.cos(place.heading_rad), np.sin(place.heading_rad)
    x, y, z = place.x_m, place.y_m, place.z_m
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])
