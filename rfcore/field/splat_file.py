"""Splat files of other programs, told by their content: ``.ply``, ``.spz`` and glTF are read.

What is not read is named with the command that converts it, of PlayCanvas's splat-transform, which
tells formats by their suffixes. So are a ``.gltf`` and other JSON here.
"""

from __future__ import annotations

import shlex
import zlib
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError
from rfcore.field.gltf import MAGIC as GLTF_MAGIC
from rfcore.field.gltf import read_open_gltf
from rfcore.field.splat_ply import read_open_ply
from rfcore.field.spz import GZIP_MAGIC, MAGIC, read_open_spz
from rfcore.field.stored_splats import ImportedSplats, settled
from rfcore.files import DECODED_BYTES

SPLAT_SUFFIXES = (".ply", ".spz", ".glb", ".gltf")
START_BYTES = 1024
"""Bytes of a file that tell its format; what gzip packed begins behind its name."""
CONVERTED = (".splat", ".ksplat", ".sog", ".lcc", ".lcc2", "meta.json")
"""Ends of the names of files that splat-transform reads."""
LEVELS = (".lcc", ".lcc2")
"""Suffixes of formats with levels of detail, which splat-transform puts one over the other."""
SOG_PICTURES = (b".webp", b"meta.json")
ZIP_MAGIC, ZIP_NAME_AT = b"PK\x03\x04", 30


class SplatFormat(StrEnum):
    """Formats that are read."""

    PLY = "ply"
    SPZ = "spz"
    GLTF = "gltf"


READERS = {
    SplatFormat.PLY: read_open_ply,
    SplatFormat.SPZ: read_open_spz,
    SplatFormat.GLTF: read_open_gltf,
}


def splat_format(path: Path, start: bytes) -> SplatFormat:
    """Return the format of a file that begins with ``start``.

    Raises ``FieldFormatError`` for one that is not read, saying what it is and what converts it.
    """
    if start.startswith(b"ply"):
        return SplatFormat.PLY
    if _is_packed_ply(start):
        plain = path.with_suffix("") if path.stem.lower().endswith(".ply") else f"{path}.ply"
        source, target = shlex.quote(str(path)), shlex.quote(str(plain))
        raise FieldFormatError(
            f"{path}: is a .ply that gzip packed; unpack it: gunzip -c {source} > {target}"
        )
    if start.startswith((GZIP_MAGIC, MAGIC.to_bytes(4, "little"))):
        return SplatFormat.SPZ
    if start.startswith(GLTF_MAGIC) or (is_json(start) and path.suffix.lower() == ".gltf"):
        return SplatFormat.GLTF
    raise FieldFormatError(f"{path}: {_what_else(path, start)}")


def _is_packed_ply(start: bytes) -> bool:
    try:
        return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, 3) == b"ply"
    except zlib.error:
        return False


def is_json(start: bytes) -> bool:
    """Tell whether a file that begins so may be a JSON object."""
    return start.lstrip().startswith(b"{")


def looks_like_splats(path: Path) -> bool:
    """Tell whether a file is of a format that holds splats, read here or not."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(START_BYTES)
    read = (b"ply", GZIP_MAGIC, MAGIC.to_bytes(4, "little"), ZIP_MAGIC, GLTF_MAGIC)
    named = (*SPLAT_SUFFIXES, *CONVERTED, ".sogs")
    return start.startswith(read) or path.name.lower().endswith(named)


def _what_else(path: Path, start: bytes) -> str:
    suffix = path.suffix.lower()
    if start.startswith(ZIP_MAGIC):
        name = start[ZIP_NAME_AT:].partition(b"PK")[0]
        if any(picture in name for picture in SOG_PICTURES):
            return _converted("a .sog of PlayCanvas", path, "" if suffix == ".sog" else ".sog")
        words = " ".join(shlex.quote(str(name)) for name in (path, path.with_suffix("")))
        return f"is a zip archive; unpack it and import what it holds: python -m zipfile -e {words}"
    ending = next((end for end in CONVERTED if path.name.lower().endswith(end)), None)
    if ending is not None:
        return _converted(f"of format {ending}", path)
    begins = f"begins with {start[:8]!r}" if start else "is empty"
    return f"is no .ply, .spz or .glb by its content: it {begins}"


def _converted(what: str, path: Path, wanted_suffix: str = "") -> str:
    """Say what converts a file; it has to be named with ``wanted_suffix`` first, if that is set."""
    named = path.with_suffix(wanted_suffix) if wanted_suffix else path
    source, target = shlex.quote(str(named)), shlex.quote(str(path.with_suffix(".ply")))
    copied = f"cp {shlex.quote(str(path))} {source} && " if wanted_suffix else ""
    how, program = "(with Node.js)", "@playcanvas/splat-transform"
    if path.suffix.lower() in LEVELS:
        how = "(with Node.js; its finest level) and import it with --up -y"
        program += "@3 --select-lod 0"
    command = f"{copied}npx {program} {source} {target}"
    return f"is {what}, which is not read; convert it {how}: {command}"


def read_splat_file(
    path: Path, tile_origin: TileOrigin | None = None, max_bytes: int = DECODED_BYTES
) -> ImportedSplats:
    """Return a file's splats of SH degree 0..3 relative to ``tile_origin`` (None: chosen as
    ``rfcore.field.stored_splats`` says), subtracted in float64.

    Raises ``FieldFormatError`` naming the file and what is wrong with it, for a format that is not
    read, and for splats that take more than ``max_bytes`` of memory.
    """
    try:
        with path.open("rb") as file:
            return read_open_splat_file(path, file, tile_origin, max_bytes)
    except OSError as error:
        raise FieldFormatError(f"{path}: cannot be read ({error.strerror})") from error


def read_open_splat_file(
    path: Path, file: BinaryIO, tile_origin: TileOrigin | None, max_bytes: int
) -> ImportedSplats:
    """Read an open file named ``path`` as ``read_splat_file`` does."""
    form = splat_format(path, file.read(START_BYTES))
    file.seek(0)
    return settled(path, READERS[form](path, file, max_bytes), tile_origin)
