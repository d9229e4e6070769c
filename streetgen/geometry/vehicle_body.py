"""Make a vehicle's body: the lofted surface, its ends and its underside, cut by material.

All parts share one set of smooth normals, so that no edge shows where paint meets glass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from streetgen.classes import Label
from streetgen.geometry.mesh import F64, I32, Mesh
from streetgen.geometry.vehicle_section import (
    END_M,
    FILLET_RINGS,
    SEAM_M,
    Lofted,
    Rows,
    lofted,
    sill_line,
)
from streetgen.geometry.vehicle_shape import BodyShape

COLUMNS = 16
"""Number of columns across nose and tail."""
PAINT, GLASS, TRIM, SEAM, LAMP, TAIL_LAMP, GRILLE, BRIGHT, DRL = range(9)
Codes = NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """A grid of points [A, B, 3] whose quads have a material code each, [A - 1, B - 1]."""

    points: F64
    codes: Codes


@dataclass(frozen=True, eq=False)
class BodySurface:
    """The loft and its two ends, with the places for fittings."""

    sides: Lofted
    nose: SurfaceGrid
    tail: SurfaceGrid
    codes: Codes

    def column(self, station: float) -> int:
        """Return the loft's column nearest to a station."""
        inner = self.sides.at[FILLET_RINGS:-FILLET_RINGS]
        return FILLET_RINGS + int(np.abs(inner - station).argmin())

    def point(self, station: float, row: int, side: int) -> F64:
        """Return the point of a row on the left (+1) or the right (-1)."""
        columns = np.array([self.column(station)], np.int32)
        return np.asarray(self.path(columns, row, side)[0][0])

    def path(self, columns: I32, row: int, side: int) -> tuple[F64, F64]:
        """Return a row's points [N, 3] on one side and where the surface looks there."""
        points = self.sides.points
        j = row if side < 0 else points.shape[1] - 1 - row
        along = points[np.minimum(columns + 1, len(points) - 1), j] - points[columns - 1, j]
        over = points[columns, j + 1] - points[columns, j - 1]
        outwards = np.cross(over, along)
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
        return points[columns, j], outwards


def surface_of(shape: BodyShape) -> BodySurface:
    """Return a body's surface in the vehicle's frame."""
    sides = lofted(shape)
    nose = _end(shape, sides.points[0], nose=True)
    tail = _end(shape, sides.points[-1][::-1], nose=False)
    return BodySurface(sides, nose, tail, _side_codes(shape, sides))


def body(shape: BodyShape, surface: BodySurface, paint: str) -> list[Mesh]:
    """Return the body in the vehicle's frame (see ``lofted``), one mesh a material."""
    patches = [SurfaceGrid(surface.sides.points, surface.codes), surface.nose, surface.tail]
    names = {
        PAINT: paint,
        GLASS: "car glass",
        TRIM: "car trim",
        SEAM: "car gap",
        LAMP: "car lamp",
        TAIL_LAMP: "car tail lamp",
        GRILLE: "car grille",
        BRIGHT: "car chrome",
        DRL: "car lamp light",
    }
    return [*_cut(patches, names), _underside(shape, surface.sides)]


def _side_codes(shape: BodyShape, surface: Lofted) -> Codes:
    """Return the codes of the lofted quads; the section is mirrored at its middle."""
    at = 0.5 * (surface.at[1:] + surface.at[:-1])
    half = np.full((len(at), Rows.MIDDLE), PAINT, np.int8)
    glazed = slice(Rows.GLASS_LOW, Rows.GLASS_HIGH)
    for start, end in shape.side_windows:
        framed = (at > start - 0.09) & (at < end + 0.09)
        half[framed, Rows.BELT : Rows.GLASS_LOW] = TRIM
        half[framed, glazed] = TRIM
    for start, end in shape.side_windows:
        half[(at > start) & (at < end), glazed] = GLASS
    cowl = shape.windscreen[0]
    half[(at > cowl - 0.07) & (at < cowl), Rows.SCREEN :] = TRIM
    for span in (shape.windscreen, shape.rear_window):
        if span is not None:
            half[(at > span[0]) & (at < span[1]), Rows.SCREEN :] = GLASS
    for door in shape.doors:
        half[np.abs(at - door) < SEAM_M / 2, 1 : Rows.EDGE] = SEAM
    if shape.cladding:
        half[:, : Rows.SILL_TOP] = TRIM
    half[at < END_M + 0.24, Rows.LAMP_LOW : Rows.LAMP_HIGH] = LAMP
    half[at < END_M + 0.24, Rows.LAMP_LOW] = DRL
    if shape.bow_m[1] > 0:
        half[at > shape.length_m - END_M - 0.2, Rows.LAMP_LOW : Rows.LAMP_HIGH] = TAIL_LAMP
        half[at > shape.length_m - END_M - 0.2, Rows.LAMP_LOW] = TRIM
    return np.concatenate([half, half[:, ::-1]], axis=1)


def _end(shape: BodyShape, outline: F64, nose: bool) -> SurfaceGrid:
    """Return a face that closes the outline [2 M + 1, 3]; columns run from side to side."""
    rows = Rows.MIDDLE + 1
    start, end = outline[:rows], outline[: rows - 2 : -1]
    share = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, COLUMNS + 1))
    share = 0.5 * share + 0.5 * np.linspace(0, 1, COLUMNS + 1)
    points = start[:, None] * (1 - share[None, :, None]) + end[:, None] * share[None, :, None]
    bow = shape.bow_m[0 if nose else 1]
    y = points[..., 1] / (0.5 * shape.width_m)
    y_edge = start[:, None, 1] / (0.5 * shape.width_m)
    points[..., 0] += (1 if nose else -1) * bow * (y_edge**2 - y**2)
    codes = np.full((rows - 1, COLUMNS), PAINT, np.int8)
    from_middle = np.abs(np.arange(COLUMNS) + 0.5 - COLUMNS / 2) / (COLUMNS / 2)
    outer = from_middle > 0.55
    codes[: Rows.SILL_TOP] = TRIM
    codes[Rows.LAMP_LOW : Rows.LAMP_HIGH, outer] = LAMP if nose else TAIL_LAMP
    codes[Rows.LAMP_LOW, outer] = DRL if nose else TRIM
    if nose:
        codes[Rows.GRILLE_LOW - 1 : Rows.GRILLE_HIGH, from_middle < 0.82] = GRILLE
        codes[Rows.LAMP_LOW : Rows.LAMP_HIGH, from_middle < 0.5] = GRILLE
        codes[Rows.LAMP_HIGH - 1, from_middle < 0.5] = BRIGHT
    return SurfaceGrid(points, codes)


def _cut(patches: list[SurfaceGrid], names: dict[int, str]) -> list[Mesh]:
    """Return a mesh for each material, with the normals of the whole surface."""
    points = np.concatenate([patch.points.reshape(-1, 3) for patch in patches])
    starts = np.cumsum([0] + [patch.points[..., 0].size for patch in patches[:-1]])
    quads = [_quads(p, start) for p, start in zip(patches, starts.tolist(), strict=True)]
    corners, codes = np.concatenate(quads), np.concatenate([p.codes.ravel() for p in patches])
    faces = np.stack([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]], axis=1)
    normals = _smooth_normals(points, faces.reshape(-1, 3))
    meshes = []
    for code, name in names.items():
        chosen = faces[codes == code].reshape(-1, 3)
        if len(chosen):
            used, compact = np.unique(chosen, return_inverse=True)
            meshes.append(
                Mesh(
                    vertices=points[used].astype(np.float32),
                    faces=compact.reshape(-1, 3).astype(np.int32),
                    uv=points[used][:, [0, 2]].astype(np.float32),
                    material=name,
                    label=Label.VEHICLE,
                    normals=normals[used].astype(np.float32),
                )
            )
    return meshes


def _quads(patch: SurfaceGrid, start: int) -> I32:
    """Return corner numbers [Q, 4], anticlockwise seen from outside."""
    count, width = patch.points.shape[:2]
    first = np.arange(count - 1)[:, None] * width + np.arange(width - 1)[None]
    corners = [first, first + 1, first + width + 1, first + width]
    return np.stack(corners, axis=2).reshape(-1, 4).astype(np.int32) + start


def _smooth_normals(points: F64, faces: I32) -> F64:
    """Return area-weighted mean normals; points at the same place share one."""
    _, place = np.unique(np.round(points, 4), axis=0, return_inverse=True)
    a, b, c = (points[faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    total = np.zeros((place.max() + 1, 3))
    for corner in range(3):
        np.add.at(total, place.ravel()[faces[:, corner]], area)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return np.asarray(total[place.ravel()])


def _underside(shape: BodyShape, surface: Lofted) -> Mesh:
    """Return the dark floor, with a tunnel over each pair of wheels."""
    right, left = surface.points[:, 0], surface.points[:, -1]
    points = np.stack([right, left], axis=1)
    points[..., 2] = np.minimum(points[..., 2], sill_line(shape, surface.at)[:, None])
    count = len(points)
    first = np.arange(0, 2 * (count - 1), 2)
    corners = np.stack([first, first + 2, first + 3, first + 1], axis=1)
    flat = points.reshape(-1, 3).astype(np.float32)
    return Mesh(
        vertices=flat,
        faces=corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32),
        uv=np.ascontiguousarray(flat[:, :2]),
        material="car gap",
        label=Label.VEHICLE,
    )
