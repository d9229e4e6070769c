"""Make the fittings of a vehicle's body, and the materials of vehicles.

Fittings are mirrors, handles, number plates, gaps between panels, lamp optics and wipers. Paints
are common colours of European cars, as linear reflectances.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from streetgen.classes import Label
from streetgen.geometry.mesh import F64, Material, Mesh
from streetgen.geometry.signage import Lettered, atlas, atlas_uv
from streetgen.geometry.solids import Surface, boxes, disc, quads, tube
from streetgen.geometry.vehicle_body import BodySurface
from streetgen.geometry.vehicle_section import FILLET_RINGS, Rows
from streetgen.geometry.vehicle_shape import BodyShape

PAINTS = {
    "paint white": (0.78, 0.78, 0.76),
    "paint silver": (0.46, 0.47, 0.48),
    "paint grey": (0.13, 0.135, 0.14),
    "paint black": (0.012, 0.012, 0.014),
    "paint blue": (0.012, 0.045, 0.20),
    "paint light blue": (0.12, 0.26, 0.42),
    "paint red": (0.42, 0.012, 0.012),
    "paint green": (0.02, 0.085, 0.045),
    "paint beige": (0.42, 0.35, 0.24),
    "paint orange": (0.62, 0.16, 0.01),
}
PLATES = ("RF 1274", "GS 3081", "KX 5526", "MV 907 H", "BD 2468", "QP 51 L", "TU 7713", "NW 6640")
LIVERIES = ("NORDWIND", "Backhaus Emmer", "FLINK LOGISTIK", "Blumen Rosa")
LIVERY_COLOURS = (
    ((250, 250, 250), (24, 70, 130)),
    ((96, 42, 20), (240, 226, 190)),
    ((210, 30, 30), (244, 244, 244)),
    ((30, 110, 60), (245, 240, 236)),
)


@lru_cache(maxsize=1)
def vehicle_materials() -> tuple[Material, ...]:
    """Return all materials of all vehicles; the same objects at each call."""
    plates = tuple(Lettered(text, (20, 20, 24), (236, 236, 230)) for text in PLATES)
    liveries = tuple(
        Lettered(text, ink, paper, font=i, border=False)
        for i, (text, (ink, paper)) in enumerate(zip(LIVERIES, LIVERY_COLOURS, strict=True))
    )
    return (
        *(Material(name, colour, gloss=True) for name, colour in PAINTS.items()),
        Material("car glass", (0.016, 0.019, 0.021), gloss=True),
        Material("car trim", (0.018, 0.018, 0.019), roughness=0.5),
        Material("car gap", (0.006, 0.006, 0.006)),
        Material("car grille", (0.010, 0.010, 0.011), roughness=0.35),
        Material("car chrome", (0.62, 0.63, 0.65), roughness=0.18, metallic=1.0),
        Material("car lamp", (0.16, 0.17, 0.18), gloss=True),
        Material("car lamp light", (0.85, 0.87, 0.9), gloss=True),
        Material("car tail lamp", (0.24, 0.003, 0.004), gloss=True),
        Material("tyre", (0.022, 0.022, 0.023)),
        Material("rim", (0.52, 0.53, 0.55), roughness=0.28, metallic=0.9),
        Material("brake disc", (0.24, 0.23, 0.22), roughness=0.4, metallic=0.8),
        Material("number plate", atlas(plates, (416, 88)), roughness=0.4),
        Material("livery", atlas(liveries, (1024, 512)), roughness=0.35),
    )


GAP = Surface("car gap", Label.VEHICLE)
DARK = Surface("car trim", Label.VEHICLE)
PLATE = Surface("number plate", Label.VEHICLE)
CHROME = Surface("car chrome", Label.VEHICLE)
LAMP_LIGHT = Surface("car lamp light", Label.VEHICLE)
TAIL = Surface("car tail lamp", Label.VEHICLE)
PLATE_SIZE_M = (0.52, 0.11)
GAP_M = 0.007
LIFT_M = 0.002
LENS_RADIUS_M = 0.032


def trim(shape: BodyShape, surface: BodySurface, paint: str, plate: int) -> list[Mesh]:
    """Return the fittings of a body; ``plate`` numbers the text on its plates."""
    meshes = [_bonnet_gap(shape, surface, side) for side in (1, -1)]
    meshes += _tail_gaps(shape, surface)
    for side in (1, -1):
        meshes += _mirror(shape, surface, paint, side)
        meshes += _handles(shape, surface, side)
        meshes += _lamp_optics(surface, side)
    meshes += _plates(shape, surface, plate)
    meshes.append(_wipers(shape, surface))
    return meshes


def number_plate(centre: F64, forward: float, text: int) -> Mesh:
    """Return a plate that looks along x (``forward`` +1) or back (-1)."""
    half_w, half_h = PLATE_SIZE_M[0] / 2, PLATE_SIZE_M[1] / 2
    y = half_w * forward
    corners = [(0, -y, -half_h), (0, y, -half_h), (0, y, half_h), (0, -y, half_h)]
    return quads(PLATE, (np.array(corners) + centre)[None], atlas_uv(len(PLATES), text)[None])


def _ribbon(path: F64, outwards: F64) -> Mesh:
    """Return a dark line of ``GAP_M`` along a path [N, 3] over normals ``outwards`` [N, 3]."""
    along = np.gradient(path, axis=0)
    across = np.cross(outwards, along)
    across *= GAP_M / 2 / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    left, right = path + outwards * LIFT_M + across, path + outwards * LIFT_M - across
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    return quads(GAP, corners)


def _bonnet_gap(shape: BodyShape, surface: BodySurface, side: int) -> Mesh:
    """Return the gap from the lamps along the edge of the bonnet to the windscreen."""
    last = surface.column(shape.windscreen[0] - 0.08)
    columns = np.arange(FILLET_RINGS, last + 1, dtype=np.int32)
    return _ribbon(*surface.path(columns, Rows.EDGE, side))


def _tail_gaps(shape: BodyShape, surface: BodySurface) -> list[Mesh]:
    """Return the upper edge of the bumper, and the sides of the door above it."""
    tail = surface.tail
    level = tail.points[Rows.GRILLE_HIGH]
    back = np.broadcast_to([-1.0, 0.0, 0.0], level.shape)
    found = [_ribbon(level, back)]
    for column in (2, len(level) - 3):
        upright = tail.points[Rows.GRILLE_HIGH : Rows.EDGE, column]
        found.append(_ribbon(upright, np.broadcast_to([-1.0, 0.0, 0.0], upright.shape)))
    if shape.rear_window is None:
        middle = tail.points[Rows.SILL_TOP : Rows.EDGE, len(level) // 2]
        found.append(_ribbon(middle, np.broadcast_to([-1.0, 0.0, 0.0], middle.shape)))
    return found


def _mirror(shape: BodyShape, surface: BodySurface, paint: str, side: int) -> list[Mesh]:
    station = shape.side_windows[0][0] + 0.10
    foot = surface.point(station, Rows.GLASS_LOW, side)
    middle = foot + np.array([0.02, side * 0.135, 0.075])
    shell = _ellipsoid(Surface(paint, Label.VEHICLE), middle, np.array([0.075, 0.125, 0.08]))
    glass = disc(CHROME, middle - (0.052, 0, 0), (-1, 0, 0), 0.07, 16)
    arm = boxes(DARK, np.minimum(foot, middle) - 0.015, np.maximum(foot, middle) + 0.015)
    return [shell, glass, arm]


def _ellipsoid(made_of: Surface, middle: F64, radii: F64) -> Mesh:
    """Return an ellipsoid that is cut flat behind at 0.65 of its length."""
    away = np.linspace(0.03, np.pi - 0.03, 9)[:, None]
    turn = np.linspace(0, 2 * np.pi, 15)[None]
    across = np.sin(away)
    unit = np.stack(
        [np.cos(away) + 0 * turn, across * np.cos(turn), across * np.sin(turn)], axis=2
    ).reshape(-1, 3)
    normals = unit / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = (np.arange(8)[:, None] * 15 + np.arange(14)[None]).reshape(-1)
    corners = np.stack([first, first + 15, first + 16, first + 1], axis=1)
    return Mesh(
        vertices=(np.maximum(unit, (-0.65, -1.0, -1.0)) * radii + middle).astype(np.float32),
        faces=corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32),
        uv=np.zeros((len(unit), 2), np.float32),
        material=made_of.material,
        label=made_of.label,
        normals=normals.astype(np.float32),
    )


def _handles(shape: BodyShape, surface: BodySurface, side: int) -> list[Mesh]:
    """Return a bar in front of the rear edge of each door."""
    found = []
    for door in shape.doors[1:]:
        place = surface.point(door - 0.17, Rows.BELT - 2, side)
        half = np.array([0.085, 0.014, 0.013])
        found.append(boxes(CHROME, place - half, place + half))
    return found


def _lamp_optics(surface: BodySurface, side: int) -> list[Mesh]:
    """Return two bright lenses in each headlamp."""
    nose = surface.nose
    found = []
    middle = (nose.points.shape[1] - 1) // 2
    for columns in (5, 6):
        column = middle + side * columns
        pair = nose.points[Rows.LAMP_LOW + 1 : Rows.LAMP_HIGH, column]
        place = pair.mean(axis=0)
        found.append(
            disc(LAMP_LIGHT, place + np.array([0.012, 0, 0]), (1, 0, 0), LENS_RADIUS_M, 16)
        )
    return found


def _plates(shape: BodyShape, surface: BodySurface, text: int) -> list[Mesh]:
    nose, tail = surface.nose.points, surface.tail.points
    column = nose.shape[1] // 2
    front = nose[Rows.GRILLE_LOW + 1, column] + (0.02, 0, 0)
    row = Rows.GRILLE_LOW if shape.cladding else Rows.GRILLE_HIGH + 1
    back = tail[row : row + 2, column].mean(axis=0) - (0.02, 0, 0)
    found = []
    for place, forward in ((front, 1.0), (back, -1.0)):
        found.append(number_plate(place, forward, text))
        inside = place - (0.006 * forward, 0, 0)
        half = np.array([0.004, PLATE_SIZE_M[0] / 2 + 0.012, PLATE_SIZE_M[1] / 2 + 0.012])
        found.append(boxes(DARK, inside - half - (0.03 if forward > 0 else 0, 0, 0), inside + half))
    return found


def _wipers(shape: BodyShape, surface: BodySurface) -> Mesh:
    """Return two blades at rest along the lower edge of the windscreen."""
    station = shape.windscreen[0] + 0.06
    row = Rows.SCREEN + 1
    start, end = (surface.point(station, row, side) for side in (1, -1))
    return tube(DARK, np.linspace(start, end, 6) + np.array([0, 0, 0.022]), 0.009, 5)
