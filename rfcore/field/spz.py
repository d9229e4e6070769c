"""3D Gaussians as SPZ, a compressed format of web viewers (github.com/nianticlabs/spz).

One block an attribute, all little-endian: positions as 24-bit fixed point (version 1: float16),
opacity in 8 bits, the first band of the colour as ``0.15 sh + 0.5``, logarithms of the scales in
sixteenths from -10 on, rotations by their three smallest components of 10 bits (versions 1 and 2:
x, y, z in 8 bits), the other bands as ``128 sh + 128`` rounded to 5 bits (first band) and 4 bits.
Versions 1 to 3 are one gzip stream with a header of 16 bytes, version 4 has a plain header of 32
bytes, a table of lengths and one Zstandard stream a block that is not empty. Extensions, records of
a type, a length and so many bytes, stand behind the splats, in version 4 before the table.
Versions 1 to 4 are read, 3 and 4 are written.

It is lossy: for looking at rather than for coding against. 24 bits have no room for a street and
its sky, which is brought to 2 km.

**Axes.** The extension ``COORDINATE_SYSTEM`` (SPZ_ADOBE_coordinate_system) names what x, y and z of
the file point to; it is obeyed, so that splats come in with the axes of a .ply, RDF (right, down,
front), in which up is -y. Version 4 is written with it, and where the field's vertical is another
with a record of our own, the vertical as three float32. Without it, tools disagree: splat-transform
3 keeps the axes of a .ply, Niantic's library and splat-transform 2 turn them half round x. Such a
file is taken as it is.
"""

from __future__ import annotations

import gzip
import io
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import Pose, Vec3
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.extras import needs
from rfcore.field.similarity import turned_rotations, turned_sh
from rfcore.field.splat_archive import check_decoded_size
from rfcore.field.stored_splats import F64, StoredSplats, finite_logits
from rfcore.files import write_whole
from rfcore.raster.gaussians import F32, Gaussians, with_sky_at
from rfcore.vertical import check_direction

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, count, SH degree, fraction bits, flags; reserved, or in version 4 the number of
streams."""
HEADER_4_BYTES = 32
GZIP_MAGIC = b"\x1f\x8b"
ANTIALIASED_FLAG, EXTENSIONS_FLAG = 1, 2
RECORD = struct.Struct("<II")
MAX_EXTENSIONS_BYTES = 1 << 24
COORDINATE_SYSTEM = 0xADBE0003
VERTICAL, DIRECTION = 0x52460001, struct.Struct("<fff")
"""Our own extension, which is obeyed in a file with the axes of a .ply."""
MOST_NAMED = 8
"""Extensions that are named, of those left out."""
SYSTEMS = [
    *(f"{x}{y}{z}" for z in "BF" for y in "DU" for x in "LR"),
    *(f"{x}{y}{z}" for y in "FB" for z in "DU" for x in "LR"),
]
"""Names of the coordinate systems 1 to 16, LDB to RBU: what x, y and z point to."""
PLY_AXES = "RDF"
PLY_UP: Vec3 = (0.0, -1.0, 0.0)
TOWARDS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0)} | {
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}
"""Directions with the axes of a .ply."""
MOST_SH_DEGREE = 4
FIXED_POINT_BITS = 24
FINEST_FRACTION_BITS = 12
COLOUR_SCALE = 0.15
SKY_DISTANCE_M = 2000.0
GZIP_LEVEL, ZSTANDARD_LEVEL = 6, 12

Version = Literal[3, 4]
U8 = NDArray[np.uint8]


def write_spz(
    path: Path,
    gaussians: Gaussians,
    *,
    antialiased: bool,
    version: Version = 3,
    up: Vec3 = PLY_UP,
) -> None:
    """Write ``path``, whole or not at all; raises what ``encode_spz`` raises."""
    write_whole(path, encode_spz(gaussians, antialiased=antialiased, version=version, up=up))


def encode_spz(
    gaussians: Gaussians, *, antialiased: bool, version: Version = 3, up: Vec3 = PLY_UP
) -> bytes:
    """Return ``gaussians`` as a file. The same Gaussians give the same bytes.

    Version 4 states ``up``, the vertical.

    Raises ``InvalidInput`` where a mean is farther from the origin than 24 bits of whole metres,
    ``BackendUnavailable`` for version 4 without Zstandard.
    """
    gaussians = with_sky_at(gaussians, SKY_DISTANCE_M)
    fraction_bits = _fraction_bits(gaussians.means)
    opacity = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    blocks = (
        _fixed_point(gaussians.means, fraction_bits),
        _byte(opacity * 255.0),
        _byte((gaussians.sh[:, 0] * COLOUR_SCALE + 0.5) * 255.0),
        _byte((gaussians.log_scales + 10.0) * 16.0),
        _smallest_three(gaussians.quaternions),
        _harmonics(gaussians.sh[:, 1:]),
    )
    filled = [block.tobytes() for block in blocks if block.size]
    flags = ANTIALIASED_FLAG * antialiased | EXTENSIONS_FLAG * (version == 4)
    header = HEADER.pack(
        *(MAGIC, version, len(gaussians), gaussians.sh_degree, fraction_bits, flags),
        len(filled) if version == 4 else 0,
    )
    if version == 3:
        return gzip.compress(header + b"".join(filled), GZIP_LEVEL, mtime=0)
    with needs("spz"):
        from zstandard import ZstdCompressor

    axes = struct.pack("<I", SYSTEMS.index(PLY_AXES) + 1)
    extension = RECORD.pack(COORDINATE_SYSTEM, len(axes)) + axes
    if up != PLY_UP:
        extension += RECORD.pack(VERTICAL, DIRECTION.size) + DIRECTION.pack(*up)
    coded = [ZstdCompressor(ZSTANDARD_LEVEL).compress(block) for block in filled]
    table = [struct.pack("<QQ", *map(len, pair)) for pair in zip(coded, filled, strict=True)]
    table_at = struct.pack("<I12x", HEADER_4_BYTES + len(extension))
    return b"".join([header, table_at, extension, *table, *coded])


def _fraction_bits(means_m: F32) -> int:
    """Return how many of the 24 bits can stand behind the binary point."""
    farthest_m = float(np.abs(means_m).max(initial=1.0))
    whole_bits = max(1, math.ceil(math.log2(farthest_m + 1.0)))
    bits = min(FINEST_FRACTION_BITS, FIXED_POINT_BITS - 1 - whole_bits)
    if bits < 0:
        limit_m = 2 ** (FIXED_POINT_BITS - 1) - 1
        raise InvalidInput("means", f"{farthest_m:g} m from the origin; .spz reaches {limit_m} m")
    return bits


def _fixed_point(means_m: F32, fraction_bits: int) -> U8:
    """Return [N, 3, 3] bytes, the least significant first."""
    fixed = np.round(means_m.astype(np.float64) * 2**fraction_bits).astype("<i4")
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3])


def _byte(values: NDArray[np.floating]) -> U8:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _smallest_three(quaternions: F32) -> NDArray[np.uint32]:
    """Return [N]: the index of the largest of x, y, z, w in 2 bits, then sign and 9 bits of each
    other component, as shares of the square root of one half."""
    xyzw = np.roll(quaternions.astype(np.float64), -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    flipped = np.take_along_axis(xyzw, largest[:, None], axis=1)[:, 0] < 0
    shares = np.round(np.abs(xyzw) * math.sqrt(2.0) * 511.0).astype(np.uint32)
    signs = ((xyzw < 0) ^ flipped[:, None]).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for axis in range(4):
        wider = (packed << np.uint32(10)) | (signs[:, axis] << np.uint32(9)) | shares[:, axis]
        packed = np.where(largest == axis, packed, wider)
    coded: NDArray[np.uint32] = packed.astype("<u4")
    return coded


def _harmonics(bands: F32) -> U8:
    """Return [N, K - 1, 3], the three of the first band in steps of 8, the rest of 16."""
    steps = np.where(np.arange(bands.shape[1]) < 3, 8, 16)[:, None]
    levels = np.round(bands * 128.0) + 128.0
    coarse = np.floor((levels + steps // 2) / steps) * steps
    return _byte(coarse)


class _Stream(Protocol):
    def read(self, size: int, /) -> bytes: ...


@dataclass(frozen=True)
class _Header:
    """The header of a file of any version."""

    version: int
    count: int
    sh_degree: int
    fraction_bits: int
    flags: int

    @property
    def splat_bytes(self) -> tuple[int, ...]:
        """Bytes of one splat: position, opacity, colour, scale, rotation, other bands."""
        position, rotation = 6 if self.version == 1 else 9, 3 if self.version < 3 else 4
        return (position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1))

    @property
    def block_bytes(self) -> tuple[int, ...]:
        """Bytes of all splats, block by block."""
        return tuple(self.count * size for size in self.splat_bytes)


def read_open_spz(path: Path, file: BinaryIO, max_bytes: int) -> StoredSplats:
    """Return the splats of an open file named ``path``.

    Raises ``FieldFormatError`` for other versions, what is cut short or too long, and for splats
    that take more than ``max_bytes`` of memory.
    """
    try:
        header, blocks, extensions = _parts(path, file, max_bytes)
        return _with_ply_axes(_splats(header, blocks), dict(_records(extensions)))
    except (InvalidInput, EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise FieldFormatError(f"{path}: {error}") from error


def _parts(path: Path, file: BinaryIO, max_bytes: int) -> tuple[_Header, list[U8], bytes]:
    """Return the header, the blocks and the records of extensions."""
    start = file.read(HEADER_4_BYTES)
    if not start.startswith(GZIP_MAGIC):
        header = _header(path, start, (4,), max_bytes)
        return header, *_zstandard_blocks(path, file, header, start)
    file.seek(0)
    with gzip.GzipFile(fileobj=file) as stream:
        header = _header(path, stream.read(HEADER.size), (1, 2, 3), max_bytes)
        blocks = [_exactly(stream, size) for size in header.block_bytes]
        extensions = stream.read(MAX_EXTENSIONS_BYTES) if header.flags & EXTENSIONS_FLAG else b""
        if stream.read(1):
            raise FieldFormatError(f"{path}: goes on after its {header.count} splats")
        return header, blocks, extensions


def _header(path: Path, data: bytes, versions: tuple[int, ...], max_bytes: int) -> _Header:
    if len(data) < HEADER.size or HEADER.unpack_from(data)[0] != MAGIC:
        raise FieldFormatError(f"{path}: is no .spz: it does not begin with NGSP")
    _, version, count, sh_degree, fraction_bits, flags, _ = HEADER.unpack_from(data)
    if version not in versions:
        raise FieldFormatError(
            f"{path}: .spz of version {version}, packed as {versions[-1]}; 1 to 4 are read: export "
            "it as version 3 or 4"
        )
    if sh_degree > MOST_SH_DEGREE or fraction_bits >= FIXED_POINT_BITS:
        raise FieldFormatError(
            f"{path}: SH degree {sh_degree} and {fraction_bits} fraction bits; degrees "
            f"0..{MOST_SH_DEGREE} and 0..{FIXED_POINT_BITS - 1} bits are read: it is damaged"
        )
    check_decoded_size(count, sh_degree, max_bytes)
    return _Header(version, count, sh_degree, fraction_bits, flags)


def needs_zstandard(start: bytes) -> bool:
    """Tell whether a file that begins so is of a version that Zstandard compresses."""
    return start.startswith(MAGIC.to_bytes(4, "little"))


def load_zstandard() -> None:
    """Import Zstandard, which cannot be done in a sandbox; raise ``BackendUnavailable``."""
    with needs("spz"):
        import zstandard  # noqa: F401


def _zstandard_blocks(
    path: Path, file: BinaryIO, header: _Header, start: bytes
) -> tuple[list[U8], bytes]:
    with needs("spz"):
        from zstandard import ZstdDecompressor, ZstdError

    if len(start) < HEADER_4_BYTES:
        raise FieldFormatError(f"{path}: ends within its header of {HEADER_4_BYTES} bytes")
    count, table_at = struct.unpack_from("<BI", start, HEADER.size - 1)
    sizes = [size for size in header.block_bytes if size or count == len(header.block_bytes)]
    extensions_bytes = table_at - HEADER_4_BYTES
    if count != len(sizes) or not 0 <= extensions_bytes <= MAX_EXTENSIONS_BYTES:
        raise FieldFormatError(f"{path}: {count} streams from byte {table_at} on are no .spz")
    extensions = _exactly(file, extensions_bytes).tobytes()
    table = _exactly(file, 16 * count).view("<u8").reshape(count, 2).tolist()
    blocks = []
    for size, (coded_bytes, decoded_bytes) in zip(sizes, table, strict=True):
        if decoded_bytes != size or coded_bytes > size + size // 128 + 1024:
            raise FieldFormatError(
                f"{path}: a stream of {coded_bytes} for {decoded_bytes} bytes where {size} are due"
            )
        coded = io.BytesIO(_exactly(file, coded_bytes).tobytes())
        try:
            blocks.append(_exactly(ZstdDecompressor().stream_reader(coded), size))
        except ZstdError as error:
            raise FieldFormatError(f"{path}: {error}") from error
    filled = iter([block for block in blocks if block.size])
    blocks = [next(filled) if size else np.empty(0, np.uint8) for size in header.block_bytes]
    return blocks, extensions if header.flags & EXTENSIONS_FLAG else b""


def _records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the type and the content of each record; raise ``EOFError``."""
    at = 0
    while at < len(extensions):
        if at + RECORD.size > len(extensions):
            raise EOFError("ends within the head of an extension")
        kind, size = RECORD.unpack_from(extensions, at)
        at += RECORD.size + size
        if at > len(extensions):
            raise EOFError(f"ends within an extension of {size} bytes")
        yield kind, extensions[at - size : at]


def _exactly(stream: _Stream, size: int) -> U8:
    data = stream.read(size)
    if len(data) < size:
        raise EOFError(f"ends {size - len(data)} bytes before the last splat")
    return np.frombuffer(data, np.uint8)


def _splats(header: _Header, blocks: list[U8]) -> StoredSplats:
    means, opacities, colours, scales, rotations, bands = (
        block.reshape(header.count, size)
        for block, size in zip(blocks, header.splat_bytes, strict=True)
    )
    decode = _from_smallest_three if header.version >= 3 else _from_xyz
    sh = np.concatenate([(colours / 255.0 - 0.5) / COLOUR_SCALE, bands / 128.0 - 1.0], axis=1)
    if header.version == 1:
        metres, step_m = means.view("<f2").astype(np.float64), 0.0
    else:
        metres, step_m = _metres(means, header.fraction_bits), 2.0**-header.fraction_bits
    return StoredSplats(
        metres,
        decode(rotations).astype(np.float32),
        (scales / 16.0 - 10.0).astype(np.float32),
        finite_logits(opacities[:, 0] / 255.0).astype(np.float32),
        sh.reshape(header.count, (header.sh_degree + 1) ** 2, 3).astype(np.float32),
        bool(header.flags & ANTIALIASED_FLAG),
        step_m,
    )


def _with_ply_axes(stored: StoredSplats, extensions: dict[int, bytes]) -> StoredSplats:
    """Return the splats with the axes of a .ply, and say what was done and left out."""
    content = extensions.pop(COORDINATE_SYSTEM, b"")
    number = int.from_bytes(content, "little")
    is_ply = number == SYSTEMS.index(PLY_AXES) + 1
    up = _up(extensions.pop(VERTICAL, b"")) if is_ply else PLY_UP
    others = ", ".join(f"{kind:#010x}" for kind in list(extensions)[:MOST_NAMED])
    notes = (f"extensions that no field has room for are left out: {others}",) if others else ()
    if not content or number == 0:
        said = (
            "axes: the file states none, so they are taken as those of a .ply; some tools turn "
            "them half round x (`rfedge field check NAME --drive DATASET --fix FILE.rff` turns "
            "them back)"
        )
        return replace(stored, notes=(said, *notes))
    if number > len(SYSTEMS):
        raise InvalidInput("axes", f"coordinate system {number}; 1 to {len(SYSTEMS)} are known")
    name = SYSTEMS[number - 1]
    said = f"axes: {name}, as the file states"
    if is_ply:
        return replace(stored, notes=(said, *notes), up=up)
    notes = (f"{said}, turned to RDF of a .ply", *notes)
    return replace(_turned(stored, name), notes=notes, up=up)


def _up(content: bytes) -> Vec3:
    """Return the vertical of our own record, or without one that of a .ply."""
    if not content:
        return PLY_UP
    if len(content) != DIRECTION.size:
        raise InvalidInput("up", f"{len(content)} bytes, where {DIRECTION.size} are due")
    x, y, z = (round(value, 6) for value in DIRECTION.unpack(content))
    check_direction("up", (x, y, z))
    return x, y, z


def _turned(stored: StoredSplats, system: str) -> StoredSplats:
    """Return splats of another coordinate system with the axes of a .ply."""
    ply_from_file = np.array([TOWARDS[letter] for letter in system], float).T
    sh, quaternions = stored.sh, stored.quaternions
    rotation = ply_from_file
    if np.linalg.det(ply_from_file) < 0:  # left-handed: y is mirrored first
        rotation = ply_from_file * (1.0, -1.0, 1.0)
        quaternions = quaternions * np.array([1, -1, 1, -1], np.float32)
        sh = sh * _odd_in_y(sh.shape[1])[:, None]
    pose = Pose.from_matrix(np.column_stack([rotation, np.zeros(3)]).tolist())
    return replace(
        stored,
        means_m=stored.means_m @ ply_from_file.T,
        quaternions=turned_rotations(quaternions, pose.rotation),
        sh=np.concatenate([turned_sh(sh[:, :16], rotation), sh[:, 16:]], axis=1),
    )


def _odd_in_y(coefficients: int) -> F32:
    """Return -1 for each harmonic whose sign is that of y, those of negative order, else 1."""
    degrees = [int(i**0.5) for i in range(coefficients)]
    return np.array([-1 if i < d * d + d else 1 for i, d in enumerate(degrees)], np.float32)


def _metres(fixed: U8, fraction_bits: int) -> F64:
    wide = np.zeros((len(fixed), 3, 4), np.uint8)
    wide[..., 1:] = fixed.reshape(len(fixed), 3, 3)
    integers = wide.view("<i4")[..., 0] >> (32 - FIXED_POINT_BITS)
    return np.asarray(integers / 2.0**fraction_bits)


def _from_xyz(coded: U8) -> NDArray[np.float64]:
    """Return [N, 4] w, x, y, z of versions 1 and 2, whose w is never negative."""
    xyz = coded / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _from_smallest_three(coded: U8) -> NDArray[np.float64]:
    """Return [N, 4] w, x, y, z from what ``_smallest_three`` writes."""
    rest = coded.reshape(-1).view("<u4").astype(np.uint32)
    largest = rest >> 30
    xyzw = np.zeros((len(rest), 4))
    for axis in (3, 2, 1, 0):
        coarse = (rest & 511) / (511.0 * math.sqrt(2.0))
        value = np.where((rest >> 9) & 1 == 1, -coarse, coarse)
        stored = largest != axis
        xyzw[stored, axis] = value[stored]
        rest = np.where(stored, rest >> 10, rest)
    length = np.sqrt(np.maximum(0.0, 1.0 - (xyzw**2).sum(axis=1)))
    np.put_along_axis(xyzw, largest.astype(np.int64)[:, None], length[:, None], axis=1)
    return np.roll(xyzw, 1, axis=1)
