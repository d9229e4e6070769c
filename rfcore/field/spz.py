"""3D Gaussians as SPZ, a compressed format of web viewers (github.com/nianticlabs/spz).

One block an attribute, all little-endian: positions as 24-bit fixed point, opacity in 8 bits, the
first band of the colour as ``0.15 sh + 0.5``, logarithms of the scales in sixteenths from -10 on,
rotations by their three smallest components of 10 bits (version 2: x, y, z in 8 bits), the other
bands as ``128 sh + 128`` rounded to 5 bits (first band) and 4 bits. Versions 2 and 3 are one gzip
stream with a header of 16 bytes, version 4 has a plain header of 32 bytes, a table of lengths and
one Zstandard stream a block. Version 3 is written, 2 to 4 are read.

It is lossy: for looking at rather than for coding against. Axes are those of the file both ways.
24 bits have no room for a street and its sky, which is brought to 2 km.
"""

from __future__ import annotations

import gzip
import io
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from rfcore.camera import TileOrigin
from rfcore.errors import FieldFormatError, InvalidInput
from rfcore.extras import needs
from rfcore.field.splat_archive import check_decoded_size
from rfcore.files import write_whole
from rfcore.raster.gaussians import Gaussians, with_sky_at

MAGIC, VERSION = 0x5053474E, 3
HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, count, SH degree, fraction bits, flags; reserved, or in version 4 the number of
streams."""
HEADER_4_BYTES = 32
GZIP_MAGIC = b"\x1f\x8b"
EXTENSIONS_FLAG = 2
CONVERT = "convert it first (npm package @playcanvas/splat-transform): splat-transform {0} {1}.ply"
ANTIALIASED_FLAG = 1
FIXED_POINT_BITS = 24
FINEST_FRACTION_BITS = 12
COLOUR_SCALE = 0.15
SKY_DISTANCE_M = 2000.0
COMPRESSION_LEVEL = 6

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


def write_spz(path: Path, gaussians: Gaussians, *, antialiased: bool) -> None:
    """Write ``path``, whole or not at all; raises what ``encode_spz`` raises."""
    write_whole(path, encode_spz(gaussians, antialiased=antialiased))


def encode_spz(gaussians: Gaussians, *, antialiased: bool) -> bytes:
    """Return ``gaussians`` as a file. The same Gaussians give the same bytes.

    Raises ``InvalidInput`` where a mean is farther from the origin than 24 bits of whole metres.
    """
    gaussians = with_sky_at(gaussians, SKY_DISTANCE_M)
    fraction_bits = _fraction_bits(gaussians.means)
    header = HEADER.pack(
        MAGIC,
        VERSION,
        len(gaussians),
        gaussians.sh_degree,
        fraction_bits,
        ANTIALIASED_FLAG if antialiased else 0,
        0,
    )
    opacity = 1.0 / (1.0 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    blocks = (
        _fixed_point(gaussians.means, fraction_bits),
        _byte(opacity * 255.0),
        _byte((gaussians.sh[:, 0] * COLOUR_SCALE + 0.5) * 255.0),
        _byte((gaussians.log_scales + 10.0) * 16.0),
        _smallest_three(gaussians.quaternions),
        _harmonics(gaussians.sh[:, 1:]),
    )
    data = header + b"".join(block.tobytes() for block in blocks)
    return gzip.compress(data, COMPRESSION_LEVEL, mtime=0)


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
        rotation = 3 if self.version == 2 else 4
        return (9, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1))

    @property
    def block_bytes(self) -> tuple[int, ...]:
        """Bytes of all splats, block by block."""
        return tuple(self.count * size for size in self.splat_bytes)


def read_open_spz(
    path: Path, file: BinaryIO, tile_origin: TileOrigin | None, max_bytes: int
) -> tuple[Gaussians, bool]:
    """Return an open file's Gaussians, ``tile_origin`` taken off, and whether they are drawn
    antialiased; ``path`` is its name.

    Opacities of 0 and 255 are taken half a step inwards, where their logits are finite. Raises
    ``FieldFormatError`` for other versions, extensions, SH beyond degree 3, what is cut short or
    too long, and for Gaussians that take more than ``max_bytes`` of memory.
    """
    try:
        header, blocks = _blocks(path, file, max_bytes)
        gaussians = _gaussians(header, blocks, tile_origin or TileOrigin())
    except (InvalidInput, EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise FieldFormatError(f"{path}: {error}") from error
    return gaussians, bool(header.flags & ANTIALIASED_FLAG)


def _blocks(path: Path, file: BinaryIO, max_bytes: int) -> tuple[_Header, list[U8]]:
    start = file.read(HEADER_4_BYTES)
    if start.startswith(GZIP_MAGIC):
        file.seek(0)
        with gzip.GzipFile(fileobj=file) as stream:
            header = _header(path, stream.read(HEADER.size), (2, 3), max_bytes)
            blocks = [_exactly(stream, size) for size in header.block_bytes]
            if stream.read(1):
                raise FieldFormatError(f"{path}: goes on after its {header.count} splats")
            return header, blocks
    header = _header(path, start, (4,), max_bytes)
    return header, _zstandard_blocks(path, file, header, start)


def _header(path: Path, data: bytes, versions: tuple[int, ...], max_bytes: int) -> _Header:
    if len(data) < HEADER.size or HEADER.unpack_from(data)[0] != MAGIC:
        raise FieldFormatError(f"{path}: is no .spz: it does not begin with NGSP")
    _, version, count, sh_degree, fraction_bits, flags, _ = HEADER.unpack_from(data)
    advice = CONVERT.format(path.name, path.stem)
    if version not in versions:
        raise FieldFormatError(f"{path}: .spz of version {version}; 2 to 4 are read: {advice}")
    if flags & EXTENSIONS_FLAG:
        raise FieldFormatError(f"{path}: has extensions of a vendor, which are not read: {advice}")
    if sh_degree > 3 or fraction_bits >= FIXED_POINT_BITS:
        raise FieldFormatError(
            f"{path}: SH degree {sh_degree} and {fraction_bits} fraction bits; degrees 0..3 and "
            f"0..{FIXED_POINT_BITS - 1} bits are read: {advice}"
        )
    check_decoded_size(count, sh_degree, max_bytes)
    return _Header(version, count, sh_degree, fraction_bits, flags)


def _zstandard_blocks(path: Path, file: BinaryIO, header: _Header, start: bytes) -> list[U8]:
    with needs("spz"):
        from zstandard import ZstdDecompressor, ZstdError

    if len(start) < HEADER_4_BYTES:
        raise FieldFormatError(f"{path}: ends within its header of {HEADER_4_BYTES} bytes")
    count, table_at = struct.unpack_from("<BI", start, HEADER.size - 1)
    if count not in (5, 6) or table_at != HEADER_4_BYTES:
        raise FieldFormatError(f"{path}: {count} streams from byte {table_at} on are no .spz")
    table = _exactly(file, 16 * count).view("<u8").reshape(count, 2).tolist()
    table += [[0, 0]] * (6 - count)
    blocks = []
    for size, (coded_bytes, decoded_bytes) in zip(header.block_bytes, table, strict=True):
        if decoded_bytes != size or coded_bytes > size + size // 128 + 1024:
            raise FieldFormatError(
                f"{path}: a stream of {coded_bytes} for {decoded_bytes} bytes where {size} are due"
            )
        coded = io.BytesIO(_exactly(file, coded_bytes).tobytes())
        try:
            blocks.append(_exactly(ZstdDecompressor().stream_reader(coded), size))
        except ZstdError as error:
            raise FieldFormatError(f"{path}: {error}") from error
    return blocks


def _exactly(stream: _Stream, size: int) -> U8:
    data = stream.read(size)
    if len(data) < size:
        raise EOFError(f"ends {size - len(data)} bytes before the last splat")
    return np.frombuffer(data, np.uint8)


def _gaussians(header: _Header, blocks: list[U8], origin: TileOrigin) -> Gaussians:
    means, opacities, colours, scales, rotations, bands = (
        block.reshape(header.count, size)
        for block, size in zip(blocks, header.splat_bytes, strict=True)
    )
    shares = np.clip(opacities[:, 0] / 255.0, 0.5 / 255.0, 254.5 / 255.0)
    decode = _from_xyz if header.version == 2 else _from_smallest_three
    sh = np.concatenate([(colours / 255.0 - 0.5) / COLOUR_SCALE, bands / 128.0 - 1.0], axis=1)
    arrays = (
        _metres(means, header.fraction_bits, origin),
        decode(rotations),
        scales / 16.0 - 10.0,
        np.log(shares / (1.0 - shares)),
        sh.reshape(header.count, (header.sh_degree + 1) ** 2, 3),
    )
    return Gaussians(*(np.ascontiguousarray(array, dtype=np.float32) for array in arrays))


def _metres(fixed: U8, fraction_bits: int, origin: TileOrigin) -> NDArray[np.float64]:
    wide = np.zeros((len(fixed), 3, 4), np.uint8)
    wide[..., 1:] = fixed.reshape(len(fixed), 3, 3)
    integers = wide.view("<i4")[..., 0] >> (32 - FIXED_POINT_BITS)
    offset_m = np.array([origin.east_m, origin.north_m, origin.up_m])
    metres: NDArray[np.float64] = integers / 2.0**fraction_bits - offset_m
    return metres


def _from_xyz(coded: U8) -> NDArray[np.float64]:
    """Return [N, 4] w, x, y, z of version 2, whose w is never negative."""
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
