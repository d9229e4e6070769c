"""3D Gaussians in the PLY layout of the INRIA reference implementation (Kerbl et al. 2023).

Vertex properties by name, in any order: ``x y z``, ``f_dc_0..2``, ``f_rest_0..``, ``opacity``
(logit), ``scale_0..2`` (log), ``rot_0..3`` (w, x, y, z). ``f_rest`` is channel-major: all
coefficients of red, then green, then blue. Normals and other properties are ignored when read;
normals are written as zeros because viewers ask for them. So write INRIA's trainer, gsplat,
nerfstudio, OpenSplat, Brush, Postshot and SuperSplat, each in an order of its own.

How splats are to be drawn is a comment of the header, ``SplatRenderMode: mip`` (antialiased: a
splat smaller than a pixel is made fainter) or ``SplatRenderMode: default``, as gsplat (pull request
1036), nerfstudio (3773) and Brush write it. The last such comment counts, in any letter case.
Postshot's ``antialiased 0`` or ``1`` is read as well.

Two properties that change what the others mean are refused by name rather than ignored:
``filter_3D`` of Mip-Splatting (its own ``create_fused_ply.py`` fuses it in), and two scales
instead of three (2D Gaussian Splatting's discs).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.ply_table import Table, read_comments, read_vertices, write_vertices
from rfcore.raster.gaussians import Gaussians

__all__ = ["read_ply", "read_ply_antialiased", "write_ply"]

XYZ = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = (0, 9, 24, 45)
"""3 ((D + 1)^2 - 1) coefficients beyond the first band for SH degree D = 0..3."""

CONVERTED = (".splat", ".ksplat", ".spz", ".sog")
"""Formats that keep fewer bits than .ply and that splat-transform converts."""
OTHERS = (".sogs", ".gltf", ".glb")
MODES = {"splatrendermode:mip": True, "splatrendermode:default": False}
"""Comments without their spaces, in lower case, and whether splats are drawn antialiased."""
POSTSHOT_MODES = {"antialiased1": True, "antialiased0": False}

F32 = NDArray[np.float32]


def read_ply(path: Path, tile_origin: TileOrigin | None = None) -> Gaussians:
    """Read Gaussians of SH degree 0..3; ``tile_origin`` is taken off the means in float64.

    Raises ``FieldFormatError`` naming the file and the property or Gaussian at fault.
    """
    _check_suffix(path)
    table = read_vertices(path, (*XYZ, *DC, "opacity", *SCALES, *ROTATION))
    if "filter_3D" in (table.dtype.names or ()):
        raise FieldFormatError(
            f"{path}: has filter_3D of Mip-Splatting; fuse it with its create_fused_ply.py first"
        )
    rest = _rest_names(path, table)
    try:
        return Gaussians(
            means=_means(table, tile_origin if tile_origin is not None else TileOrigin()),
            quaternions=_columns(table, ROTATION),
            log_scales=_columns(table, SCALES),
            opacity_logits=_columns(table, ("opacity",))[:, 0].copy(),
            sh=_coefficients(table, rest),
        )
    except InvalidInput as error:
        raise FieldFormatError(f"{path}: {error}") from error


def read_ply_antialiased(path: Path) -> bool | None:
    """Return how the header says its splats are to be drawn, ``None`` where it does not say.

    Raises ``FieldFormatError`` when the header cannot be read or names a mode there is not.
    """
    _check_suffix(path)
    stated = None
    for comment in read_comments(path):
        text = "".join(comment.lower().split())
        if text in MODES or text in POSTSHOT_MODES:
            stated = {**MODES, **POSTSHOT_MODES}[text]
        elif text.startswith("splatrendermode:"):
            raise FieldFormatError(
                f"{path}: its comment '{comment}' names neither mode, mip or default; "
                "correct it in the header"
            )
    return stated


def write_ply(path: Path, gaussians: Gaussians, *, antialiased: bool | None = None) -> None:
    """Write Gaussians as the reference implementation does; float32 survives exactly.

    ``antialiased`` becomes the ``SplatRenderMode`` comment; ``None`` writes no such comment.
    """
    rest_count = 3 * (gaussians.sh.shape[1] - 1)
    rest = tuple(f"f_rest_{i}" for i in range(rest_count))
    names = (*XYZ, *NORMALS, *DC, *rest, "opacity", *SCALES, *ROTATION)
    parts = [
        gaussians.means,
        np.zeros_like(gaussians.means),
        gaussians.sh[:, 0],
        gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussians), rest_count),
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        gaussians.quaternions,
    ]
    rows = np.concatenate(parts, axis=1).astype("<f4")
    comments = {None: (), True: ("SplatRenderMode: mip",), False: ("SplatRenderMode: default",)}
    table = rows.view([(name, "<f4") for name in names])[:, 0]
    write_vertices(path, table, comments[antialiased])


def _check_suffix(path: Path) -> None:
    suffix = path.suffix.lower()
    if suffix in OTHERS:
        raise FieldFormatError(f"{path}: {suffix} is not read; export the splats as .ply")
    if suffix in CONVERTED:
        raise FieldFormatError(
            f"{path}: {suffix} is not read; convert it first (npm package @playcanvas/"
            f"splat-transform): splat-transform {path.name} {path.stem}.ply"
        )


def _rest_names(path: Path, table: Table) -> tuple[str, ...]:
    present = {name for name in table.dtype.names or () if re.fullmatch(r"f_rest_\d+", name)}
    names = tuple(f"f_rest_{i}" for i in range(len(present)))
    if len(present) not in REST_COUNTS or present != set(names):
        raise FieldFormatError(
            f"{path}: {len(present)} f_rest properties, SH degrees 0..3 have "
            f"{', '.join(map(str, REST_COUNTS))}, numbered from 0 without a gap"
        )
    return names


def _means(table: Table, origin: TileOrigin) -> F32:
    """Subtract in float64: global coordinates need it."""
    offset_m = np.array([origin.east_m, origin.north_m, origin.up_m])
    means = np.stack([table[axis].astype(np.float64) for axis in XYZ], axis=1) - offset_m
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(means, dtype=np.float32)


def _columns(table: Table, names: tuple[str, ...]) -> F32:
    """Return [N, C]; a value beyond float32 becomes infinite and is refused as such."""
    columns = np.empty((len(table), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for column, name in enumerate(names):
            columns[:, column] = table[name]
    return columns


def _coefficients(table: Table, rest: tuple[str, ...]) -> F32:
    """Return [N, K, 3] from channel-major columns."""
    bands = len(rest) // 3
    sh = np.empty((len(table), 1 + bands, 3), np.float32)
    for channel in range(3):
        names = (DC[channel], *rest[channel * bands : (channel + 1) * bands])
        sh[:, :, channel] = _columns(table, names)
    return sh
