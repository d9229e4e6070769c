"""Reads splat files of other programs, ``.ply`` and ``.spz``, chosen by their suffix."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError
from rfcore.field.ply import antialiased_of, read_open_ply
from rfcore.field.ply_table import read_header
from rfcore.field.spz import read_open_spz
from rfcore.files import DECODED_BYTES
from rfcore.raster.gaussians import Gaussians

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
