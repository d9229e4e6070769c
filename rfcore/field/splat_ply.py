"""Splats as .ply: the layout of INRIA's reference implementation, and PlayCanvas's compressed one.

INRIA's (Kerbl et al. 2023) has vertex properties by name, in any order: ``x y z``, ``f_dc_0..2``,
``f_rest_0..``, ``opacity`` (logit), ``scale_0..2`` (log), ``rot_0..3`` (w, x, y, z). ``f_rest`` is
channel-major: all coefficients of red, then green, then blue. Normals and other properties are
ignored when read; normals are written as zeros because viewers ask for them. So write INRIA's
trainer, gsplat, nerfstudio, OpenSplat, Brush, Postshot and SuperSplat, each in an order of its own.
``red green blue`` of nerfstudio stand in for ``f_dc`` and ``f_rest``.

The compressed layout (PlayCanvas, SuperSplat, gsplat) has an element ``chunk`` with the bounds of
each 256 splats, ``vertex`` with four packed uint32 a splat (positions and log scales of 11, 10 and
11 bits, rotation by the index of its largest component of w, x, y, z and 10 bits of each other,
colour and opacity of 8 bits), and where there is more than degree 0 ``sh`` with a byte for each
``f_rest``.

How splats are to be drawn is a comment of the header, ``SplatRenderMode: mip`` (antialiased: a
splat smaller than a pixel is made fainter) or ``SplatRenderMode: default``, as gsplat (pull request
1036), nerfstudio (3773) and Brush write it. The last such comment counts, in any letter case.
Postshot's ``antialiased 0`` or ``1`` is read as well. Which way is up is a comment of our own,
``rfedge up: X Y Z``, a unit vector.

Properties that change what the others mean are refused by name rather than ignored: ``filter_3D``
of Mip-Splatting (its own ``create_fused_ply.py`` fuses it in), two scales instead of three (2D
Gaussian Splatting's discs), and those of motion (``MOVING``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Vec3
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.field.ply_table import (
    VERTEX,
    Element,
    Header,
    Table,
    checked_element,
    read_header,
    read_rows,
    write_vertices,
)
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.stored_splats import F64, StoredSplats, finite_logits, middle_of, sh_degree_of
from rfcore.harmonics import SH_DC
from rfcore.raster.gaussians import F32, Gaussians, empty_arrays
from rfcore.vertical import check_direction

XYZ = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

MODES = {"splatrendermode:mip": True, "splatrendermode:default": False}
"""Comments without their spaces, in lower case, and whether splats are drawn antialiased."""
MOVING = re.compile(r"scale_t|motion_\d+|trbf_\w+|omega_\d+|rot_r_\d+")
"""Properties of splats that move: those of SpacetimeGaussians and of 4D Gaussian Splatting."""
POSTSHOT_MODES = {"antialiased1": True, "antialiased0": False}

UP = "rfedge up:"
"""Start of the comment that says which way is up."""

CHUNK = 256
"""Splats of a chunk."""
KINDS = ("", "scale_")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
U32 = NDArray[np.uint32]


def read_open_ply(path: Path, file: BinaryIO, max_bytes: int) -> StoredSplats:
    """Read an open file of either layout.

    Raises ``FieldFormatError`` naming the file and the property at fault, and for splats that take
    more than ``max_bytes`` of memory.
    """
    header = read_header(path, file)
    try:
        if header.element("chunk") is not None:
            return _read_compressed(path, file, header, max_bytes)
        return _read_inria(path, file, header, max_bytes)
    except InvalidInput as error:
        raise FieldFormatError(f"{path}: {error}") from error


def _read_inria(path: Path, file: BinaryIO, header: Header, max_bytes: int) -> StoredSplats:
    vertex = checked_element(path, file, header, VERTEX, XYZ)
    _refuse_others(path, vertex)
    plain = DC[0] not in vertex.names and set(RGB) <= set(vertex.names)
    rest = () if plain else _rest_names(path, vertex)
    checked_element(path, file, header, VERTEX, RGB if plain else DC)
    means_m, arrays = _empty(vertex.count, rest, max_bytes)
    for start, rows in read_rows(path, file, header, vertex):
        part = slice(start, start + len(rows))
        for axis, name in enumerate(XYZ):
            means_m[part, axis] = rows[name]
        arrays["quaternions"][part] = _columns(rows, ROTATION)
        arrays["log_scales"][part] = _columns(rows, SCALES)
        arrays["opacity_logits"][part] = _columns(rows, ("opacity",))[:, 0]
        arrays["sh"][part] = _constant(rows) if plain else _coefficients(rows, rest)
    return StoredSplats(
        means_m,
        **arrays,
        antialiased=antialiased_of(path, header.comments),
        step_m=_step_m(vertex, means_m),
        notes=("colours are red, green, blue, the same from all sides",) if plain else (),
        up=up_of(path, header.comments),
    )


def _empty(count: int, rest: Sequence[str], max_bytes: int) -> tuple[F64, dict[str, F32]]:
    """Return arrays to fill, for splats with so many ``f_rest``; raise ``InvalidInput``."""
    degree = sh_degree_of(1 + len(rest) // 3)
    assert degree is not None, rest
    check_decoded_size(count, degree, max_bytes)
    arrays = empty_arrays(count, degree)
    del arrays["means"]
    return np.empty((count, 3)), arrays


def _refuse_others(path: Path, vertex: Element) -> None:
    """Raise ``FieldFormatError`` for what has other meanings, or holds no splats at all."""
    names = vertex.names
    if "filter_3D" in names:
        raise FieldFormatError(
            f"{path}: has filter_3D of Mip-Splatting; fuse it with its create_fused_ply.py first"
        )
    moving = [name for name in names if MOVING.fullmatch(name)]
    if moving:
        raise FieldFormatError(
            f"{path}: holds splats that move ({moving[0]}), which are not read; export one instant "
            "of them as a static .ply"
        )
    missing = [name for name in ("opacity", *SCALES, *ROTATION) if name not in names]
    if len(missing) == 1 + len(SCALES) + len(ROTATION):
        raise FieldFormatError(
            f"{path}: holds points, not splats (no opacity, scale_0, rot_0); "
            f"`rfedge train DATASET --points {path}` starts from them"
        )
    if missing == ["scale_2"]:
        raise FieldFormatError(
            f"{path}: no vertex property scale_2: discs of 2D Gaussian Splatting are not read"
        )
    if missing:
        raise FieldFormatError(f"{path}: no vertex property {', '.join(missing)}")


def _rest_names(path: Path, element: Element) -> tuple[str, ...]:
    present = {name for name in element.names if re.fullmatch(r"f_rest_\d+", name)}
    names = tuple(f"f_rest_{i}" for i in range(len(present)))
    if len(present) % 3 or sh_degree_of(1 + len(present) // 3) is None or present != set(names):
        raise FieldFormatError(
            f"{path}: {len(present)} f_rest properties; SH degrees 0 to 4 have 0, 9, 24, 45, 72, "
            "numbered from 0 without a gap"
        )
    return names


def _step_m(vertex: Element, means_m: F64) -> float:
    """Return the step in which positions are stored beside the median one."""
    if vertex.dtype[XYZ[0]].itemsize > 4:
        return 0.0
    return float(np.spacing(np.float32(np.abs(middle_of(means_m)).max())))


def _columns(table: Table, names: tuple[str, ...]) -> F32:
    """Return [N, C]; a value beyond float32 becomes infinite."""
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


def _constant(table: Table) -> F32:
    """Return [N, 1, 3] of colours 0..255."""
    return ((_columns(table, RGB) / 255.0 - 0.5) / SH_DC)[:, None]


def _read_compressed(path: Path, file: BinaryIO, header: Header, max_bytes: int) -> StoredSplats:
    bounds = [f"{side}_{kind}{axis}" for side in ("min", "max") for kind in KINDS for axis in XYZ]
    chunk = checked_element(path, file, header, "chunk", bounds)
    vertex = checked_element(path, file, header, VERTEX, PACKED)
    rest: tuple[str, ...] = ()
    counts, due = [chunk.count], [-(-vertex.count // CHUNK)]
    sh = header.element("sh")
    if sh is not None and not sh.names and sh.problem is None:
        sh = None  # gsplat's for degree 0
    if sh is not None:
        rest = _rest_names(path, checked_element(path, file, header, "sh", ()))
        counts, due = [*counts, sh.count], [*due, vertex.count]
    if counts != due:
        raise FieldFormatError(
            f"{path}: {counts} rows of chunk and sh where {vertex.count} splats need {due}"
        )
    means_m, arrays = _empty(vertex.count, rest, max_bytes)
    chunks = np.concatenate(
        [np.empty(0, chunk.dtype), *(rows for _, rows in read_rows(path, file, header, chunk))]
    )
    for start, rows in read_rows(path, file, header, vertex):
        part = slice(start, start + len(rows))
        own = chunks[np.arange(start, start + len(rows)) // CHUNK]
        means_m[part] = _between(own, "", XYZ, _thirds(rows["packed_position"]))
        arrays["log_scales"][part] = _between(own, "scale_", XYZ, _thirds(rows["packed_scale"]))
        arrays["quaternions"][part] = _unpacked_rotation(rows["packed_rotation"])
        rgba = (rows["packed_color"][:, None] >> np.array([24, 16, 8, 0], np.uint32) & 255) / 255
        colours = _between(own, "", "rgb", rgba[:, :3]) if "min_r" in chunk.names else rgba[:, :3]
        arrays["sh"][part, 0] = (colours - 0.5) / SH_DC
        arrays["opacity_logits"][part] = finite_logits(rgba[:, 3])
    if sh is not None:
        for start, rows in read_rows(path, file, header, sh):
            shares = (np.stack([rows[name] for name in rest], axis=1) + 0.5) / 256
            shares[shares < 1 / 256], shares[shares > 255 / 256] = 0.0, 1.0
            channels = (shares * 8 - 4).reshape(len(rows), 3, -1)
            arrays["sh"][start : start + len(rows), 1:] = channels.transpose(0, 2, 1)
    return StoredSplats(
        means_m,
        **arrays,
        antialiased=antialiased_of(path, header.comments),
        step_m=0.0,
        notes=(),
        up=up_of(path, header.comments),
    )


def _between(own: Table, kind: str, axes: Sequence[str], shares: F64) -> F64:
    """Return [N, 3] between the bounds of each splat's chunk."""
    low = np.stack([own[f"min_{kind}{axis}"] for axis in axes], axis=1).astype(np.float64)
    high = np.stack([own[f"max_{kind}{axis}"] for axis in axes], axis=1).astype(np.float64)
    return np.asarray(low * (1 - shares) + high * shares)


def _thirds(packed: U32) -> F64:
    """Return [N, 3] shares 0..1 of 11, 10 and 11 bits."""
    shifted = packed[:, None] >> np.array([21, 11, 0], np.uint32)
    most = np.array([2047, 1023, 2047], np.uint32)
    return np.asarray((shifted & most) / most)


def _unpacked_rotation(packed: U32) -> F64:
    """Return [N, 4] w, x, y, z."""
    others = ((packed[:, None] >> np.array([20, 10, 0], np.uint32) & 1023) / 1023 - 0.5) * 2**0.5
    largest = (packed >> 30).astype(np.intp)
    wxyz = np.empty((len(packed), 4))
    is_largest = np.arange(4) == largest[:, None]
    wxyz[~is_largest] = others.ravel()
    wxyz[is_largest] = np.sqrt(np.maximum(0.0, 1.0 - np.square(others).sum(axis=1)))
    return wxyz


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


def up_of(path: Path, comments: Sequence[str]) -> Vec3 | None:
    """Return which way the comments of a header say is up, or ``None``.

    Raises ``FieldFormatError`` if that is no unit vector.
    """
    stated = [comment for comment in comments if comment.startswith(UP)]
    if not stated:
        return None
    try:
        x, y, z = map(float, stated[-1].removeprefix(UP).split())
        check_direction("up", (x, y, z))
    except ValueError as error:
        raise FieldFormatError(
            f"{path}: its comment '{stated[-1]}' is no unit vector X Y Z; correct it in the header"
        ) from error
    return x, y, z


def write_ply(
    path: Path, gaussians: Gaussians, *, antialiased: bool | None = None, up: Vec3 | None = None
) -> None:
    """Write Gaussians as the reference implementation does; float32 survives exactly.

    ``antialiased`` becomes the ``SplatRenderMode`` comment, ``up``, a unit vector, the one of the
    vertical; ``None`` writes no such comment.
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
    stated = () if up is None else (f"{UP} {' '.join(f'{value:.9g}' for value in up)}",)
    write_vertices(path, table, (*comments[antialiased], *stated))
