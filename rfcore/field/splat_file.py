"""Reads splat files of other programs, ``.ply`` and ``.spz``, chosen by their suffix.

PLY files have the layout of the INRIA reference implementation (Kerbl et al. 2023). Vertex
properties by name, in any order: ``x y z``, ``f_dc_0..2``, ``f_rest_0..``, ``opacity`` (logit),
``scale_0..2`` (log), ``rot_0..3`` (w, x, y, z). ``f_rest`` is channel-major: all coefficients of
red, then green, then blue. Normals and other properties are ignored when read; normals are written
as zeros because viewers ask for them. So write INRIA's trainer, gsplat, nerfstudio, OpenSplat,
Brush, Postshot and SuperSplat, each in an order of its own.

How splats are to be drawn is a comment of the header, ``SplatRenderMode: mip`` (antialiased: a
splat smaller than a pixel is made fainter) or ``SplatRenderMode: default``, as gsplat (pull request
1036), nerfstudio (3773) and Brush write it. The last such comment counts, in any letter case.
Postshot's ``antialiased 0`` or ``1`` is read as well.

Two properties that change what the others mean are refused by name rather than ignored:
``filter_3D`` of Mip-Splatting (its own ``create_fused_ply.py`` fuses it in), and two scales
instead of three (2D Gaussian Splatting's discs).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.ply_table import (
    Header,
    Table,
    read_header,
    read_rows,
    read_vertex_header,
    write_vertices,
)
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.spz import read_open_spz
from rfcore.files import DECODED_BYTES
from rfcore.raster.gaussians import Gaussians, empty_arrays

XYZ = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = (0, 9, 24, 45)
"""3 ((D + 1)^2 - 1) coefficients beyond the first band for SH degree D = 0..3."""

MODES = {"splatrendermode:mip": True, "splatrendermode:default": False}
"""Comments without their spaces, in lower case, and whether splats are drawn antialiased."""
POSTSHOT_MODES = {"antialiased1": True, "antialiased0": False}

F32 = NDArray[np.float32]


def read_open_ply(
    path: Path, file: BinaryIO, tile_origin: TileOrigin | None, max_bytes: int
) -> Gaussians:
    """Read Gaussians of SH degree 0..3; ``tile_origin`` is subtracted from the means in float64.

    Raises ``FieldFormatError`` naming the file and the property or Gaussian at fault, and for
    Gaussians that take more than ``max_bytes`` of memory.
    """
    header = read_vertex_header(path, file, (*XYZ, *DC, "opacity", *SCALES, *ROTATION))
    if "filter_3D" in (header.dtype.names or ()):
        raise FieldFormatError(
            f"{path}: has filter_3D of Mip-Splatting; fuse it with its create_fused_ply.py first"
        )
    rest, origin = _rest_names(path, header), tile_origin or TileOrigin()
    sh_degree = math.isqrt(1 + len(rest) // 3) - 1
    try:
        check_decoded_size(header.count, sh_degree, max_bytes)
        arrays = empty_arrays(header.count, sh_degree)
        for start, rows in read_rows(path, file, header):
            part = slice(start, start + len(rows))
            arrays["means"][part] = _means(rows, origin)
            arrays["quaternions"][part] = _columns(rows, ROTATION)
            arrays["log_scales"][part] = _columns(rows, SCALES)
            arrays["opacity_logits"][part] = _columns(rows, ("opacity",))[:, 0]
            arrays["sh"][part] = _coefficients(rows, rest)
        return Gaussians(**arrays)
    except InvalidInput as error:
        raise FieldFormatError(f"{path}: {error}") from error


def antialiased_of(path: Path, comments: Sequence[str]) -> bool | None:
    """Return whether the comments of a header say that splats are drawn antialiased, or ``None``.

    Raises ``FieldFormatError`` if they name an unknown mode.
    """
    stated = None
    for comment in comments:
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


def _rest_names(path: Path, header: Header) -> tuple[str, ...]:
    present = {name for name in header.dtype.names or () if re.fullmatch(r"f_rest_\d+", name)}
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


SPLAT_SUFFIXES = (".ply", ".spz")
CONVERTED = (".splat", ".ksplat", ".sog")
"""Lossy formats that splat-transform converts."""
OTHERS = (".gltf", ".glb")


def read_splat_file(
    path: Path, tile_origin: TileOrigin | None = None, max_bytes: int = DECODED_BYTES
) -> tuple[Gaussians, bool | None]:
    """Return the Gaussians of SH degree 0..3, with ``tile_origin`` subtracted from the means in
    float64, and whether the file says that they are drawn antialiased (``None``: it does not say).

    Raises ``FieldFormatError`` naming the file and what is wrong with it, for a format that is not
    read, and for Gaussians that take more than ``max_bytes`` of memory.
    """
    check_suffix(path)
    try:
        with path.open("rb") as file:
            return read_open_splat_file(path, file, tile_origin, max_bytes)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def read_open_splat_file(
    path: Path, file: BinaryIO, tile_origin: TileOrigin | None, max_bytes: int
) -> tuple[Gaussians, bool | None]:
    """Read an open file named ``path`` as ``read_splat_file`` does."""
    if path.suffix.lower() == ".spz":
        return read_open_spz(path, file, tile_origin, max_bytes)
    gaussians = read_open_ply(path, file, tile_origin, max_bytes)
    file.seek(0)
    return gaussians, antialiased_of(path, read_header(path, file).comments)


def check_suffix(path: Path) -> None:
    """Raise ``FieldFormatError`` for a format that is not read, naming a converter."""
    suffix = path.suffix.lower()
    if suffix in OTHERS:
        raise FieldFormatError(f"{path}: {suffix} is not read; export the splats as .ply")
    if suffix == ".sogs":
        raise FieldFormatError(
            f"{path}: .sogs is not read; it is a zip: unpack it and convert what it holds (npm "
            f"package @playcanvas/splat-transform): splat-transform meta.json {path.stem}.ply"
        )
    if suffix in CONVERTED:
        raise FieldFormatError(
            f"{path}: {suffix} is not read; convert it first (npm package @playcanvas/"
            f"splat-transform): splat-transform {path.name} {path.stem}.ply"
        )
