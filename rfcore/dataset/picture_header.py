"""Reads the start of a picture file: its format, size, alpha, orientation and colours.

Formats are told by content (PNG, W3C; JPEG, ITU-T T.81; WebP, RFC 9649; EXIF, CIPA DC-008). Of
others FFmpeg decodes the picture for it. So a picture of a hostile size is refused without
allocating it, and a wrong size is found before a long run starts.
"""

from __future__ import annotations

import shlex
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, Literal

from rfcore.dataset.colour_profile import PRIMARIES, profile_of
from rfcore.dataset.orientation import Orientation
from rfcore.errors import DatasetError
from rfcore.image import read_frame
from rfcore.pixels import has_alpha, treatment

SIGNATURES = {
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"BM": "BMP",
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"v/1\x01": "OpenEXR",
    b"#?RADIANCE": "Radiance HDR",
    b"\0\0\0\x0cjP  ": "JPEG 2000",
    b"\xff\x4f\xff\x51": "JPEG 2000",
    b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL ": "JPEG XL",
    b"qoif": "QOI",
    b"P5": "PGM",
    b"P6": "PPM",
    b"PF": "PFM",
    b"Pf": "PFM",
}
UNREAD = ("JPEG XL", "HEIC")
HEIC_TO_PNG = (
    "import sys, pillow_heif as h; "
    '[h.open_heif(f).to_pillow().save(f + ".png") for f in sys.argv[1:]]'
)
HEIC = (b"heic", b"heix", b"heim", b"heis", b"mif1")
START_BYTES = 32
EXIF_START, ICC_START = b"Exif\0\0", b"ICC_PROFILE\0"
ORIENTATION_TAG, COMPRESSION_TAG, PROFILE_TAG = 0x0112, 0x0103, 0x8773
JPEG_COMPRESSIONS = (6, 7)
SHORT, FIELD_BYTES = 3, 12
"""TIFF's type of 16 bits, and the length of an entry of a directory."""
ALPHA_ITEM, PROFILE_BOX = b"urn:mpeg:mpegB:cicp:systems:auxiliary:alpha", b"colrprof"
MAX_CHUNKS = 1000
MAX_PROFILE_BYTES = 1 << 16
LINEAR_GAMMA, PQ, HLG = 100_000, 16, 18
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_BARE = frozenset(range(0xD0, 0xD9)) | {0x01}


@dataclass(frozen=True)
class PictureHeader:
    """``size_px`` is (width, height) as stored. ``treatment`` says what is done to its colours."""

    format: str
    size_px: tuple[int, int]
    has_alpha: bool = False
    orientation: Orientation = Orientation.UPRIGHT
    treatment: str | None = None
    profile: str | None = None
    """As ``rfcore.dataset.colour_profile.profile_of`` names it."""


def picture_format(path: Path) -> str | None:
    """Return the name of a picture's format, told by its content; ``None`` for another file."""
    try:
        with path.open("rb") as file:
            start = file.read(START_BYTES)
    except OSError:
        return None
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "WebP"
    if start[4:8] == b"ftyp":
        if start[8:12] == b"avif":
            return "AVIF"
        return "HEIC" if start[8:12] in HEIC else None
    return next((name for sign, name in SIGNATURES.items() if start.startswith(sign)), None)


def remedy(unread: str, files: str) -> str:
    """Return what to do with pictures of a format that is not read; ``files`` are quoted."""
    if unread == "HEIC":
        return f"convert: pip install pillow-heif && python -c '{HEIC_TO_PNG}' {files}"
    return "export as JPEG or PNG"


def picture_header(path: Path) -> PictureHeader:
    """Return what the file says; raise ``DatasetError`` naming it for one that is no picture."""
    found = picture_format(path)
    if found in UNREAD:
        raise DatasetError(f"{path}: {found} is not read; {remedy(found, shlex.quote(str(path)))}")
    try:
        with path.open("rb") as file:
            header = {"PNG": _png, "JPEG": _jpeg, "WebP": _webp}.get(found or "", _none)(file)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error
    if header is not None:
        return header
    frame = read_frame(path)
    size_px, alpha = (frame.width, frame.height), has_alpha(frame.format)
    orientation, profile = Orientation.UPRIGHT, b""
    if found == "TIFF":
        orientation, profile = _tiff(path)
    elif found == "AVIF":
        profile = _avif_profile(path)
    said = _profiled(treatment(frame), profile)
    return PictureHeader(found or "picture", size_px, alpha, orientation, *said)


def _tiff(path: Path) -> tuple[Orientation, bytes]:
    """Return a TIFF's orientation and ICC profile; raise ``DatasetError`` for JPEG inside it, of
    which FFmpeg shows wrong colours."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        tags = _directory(data)
        if tags.get(COMPRESSION_TAG, (0, 0, 0))[2] in JPEG_COMPRESSIONS:
            raise DatasetError(
                f"{path}: JPEG compression inside TIFF is not read; export the picture as JPEG or "
                "PNG"
            )
        _, length, at = tags.get(PROFILE_TAG, (0, 0, 0))
        return _turn_of(tags), data[at : at + min(length, MAX_PROFILE_BYTES)]


def _avif_profile(path: Path) -> bytes:
    """Return an AVIF's ICC profile; raise ``DatasetError`` for one with alpha, which FFmpeg leaves
    out."""
    with path.open("rb") as file:
        start = file.read(MAX_PROFILE_BYTES)
    if ALPHA_ITEM in start:
        raise DatasetError(
            f"{path}: AVIF with alpha is not read; export the picture as PNG or WebP"
        )
    at = start.find(PROFILE_BOX)
    length = int.from_bytes(start[max(at - 4, 0) : at]) - 12
    return start[at + len(PROFILE_BOX) :][:length] if at >= 0 < length else b""


def _none(_: BinaryIO) -> None:
    return None


def _png(file: BinaryIO) -> PictureHeader | None:
    chunks = dict(_chunks(file, 8))
    start = chunks.get(b"IHDR", b"")
    if len(start) < 8:
        return None
    said = None
    if int.from_bytes(chunks.get(b"gAMA", b"")) == LINEAR_GAMMA:
        said = "linear"
    coding = chunks.get(b"cICP", b"\0\0")[1:2]
    said = {bytes([PQ]): "PQ", bytes([HLG]): "HLG"}.get(coding, said)
    _, _, data = chunks.get(b"iCCP", b"").partition(b"\0")
    profile = b""
    with suppress(zlib.error):
        profile = zlib.decompressobj().decompress(data[1:], MAX_PROFILE_BYTES)
    return PictureHeader(
        "PNG",
        (int.from_bytes(start[:4]), int.from_bytes(start[4:8])),
        start[9:10] in (b"\4", b"\6") or b"tRNS" in chunks,
        _orientation(chunks.get(b"eXIf", b"")),
        *_profiled(said, profile),
    )


def _chunks(file: BinaryIO, at: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield PNG's chunks before the pixels, of each at most 64 KB."""
    for _ in range(MAX_CHUNKS):
        file.seek(at)
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IDAT":
            return
        length = int.from_bytes(head[:4])
        yield head[4:], file.read(min(length, MAX_PROFILE_BYTES))
        at += length + 12


def _jpeg(file: BinaryIO) -> PictureHeader | None:
    orientation, profile = Orientation.UPRIGHT, b""
    for marker in jpeg_segments(file):
        if marker in (0xE1, 0xE2):
            length = int.from_bytes(file.read(2)) - 2
            data = file.read(max(length, 0))
            if data.startswith(ICC_START):
                profile += data[len(ICC_START) + 2 :]  # behind its number and their count
            if data.startswith(EXIF_START):
                orientation = _orientation(data[len(EXIF_START) :])
        if marker in JPEG_FRAMES:
            start = file.read(7)
            size_px = (int.from_bytes(start[5:7]), int.from_bytes(start[3:5]))
            return PictureHeader("JPEG", size_px, False, orientation, *_profiled(None, profile))
    return None


def jpeg_segments(file: BinaryIO) -> Iterator[int]:
    """Yield the markers from the start, the file behind each; for ``JPEG_BARE`` nothing follows."""
    file.seek(2)
    while len(marker := file.read(2)) == 2 and marker[0] == 0xFF:
        if marker[1] == 0xFF:
            file.seek(-1, 1)
            continue
        at = file.tell()
        yield marker[1]
        file.seek(at)
        if marker[1] not in JPEG_BARE:
            file.seek(max(int.from_bytes(file.read(2)) - 2, 0), 1)


def _webp(file: BinaryIO) -> PictureHeader | None:
    start = file.read(START_BYTES)
    kind = start[12:16]
    if kind == b"VP8X":
        size_px = tuple(int.from_bytes(start[i : i + 3], "little") + 1 for i in (24, 27))
        exif = _webp_chunk(file, b"EXIF").removeprefix(EXIF_START) if start[20] & 0x08 else b""
        profile = _webp_chunk(file, b"ICCP") if start[20] & 0x20 else b""
        alpha, orientation = bool(start[20] & 0x10), _orientation(exif)
        return PictureHeader(
            "WebP", (size_px[0], size_px[1]), alpha, orientation, *_profiled(None, profile)
        )
    if kind == b"VP8L":
        bits = int.from_bytes(start[21:25], "little")
        size_px = ((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
        return PictureHeader("WebP", size_px, bool(bits >> 28 & 1))
    if kind == b"VP8 ":
        width, height = (int.from_bytes(start[i : i + 2], "little") & 0x3FFF for i in (26, 28))
        return PictureHeader("WebP", (width, height))
    return None


def _webp_chunk(file: BinaryIO, name: bytes) -> bytes:
    at = 12
    for _ in range(MAX_CHUNKS):
        file.seek(at)
        head = file.read(8)
        length = int.from_bytes(head[4:], "little")
        if len(head) < 8 or head[:4] == name:
            return file.read(min(length, MAX_PROFILE_BYTES))
        at += 8 + length + length % 2
    return b""


def _profiled(treatment: str | None, profile: bytes) -> tuple[str | None, str | None]:
    """Return what is done to the colours, and what an ICC profile says that they are."""
    found = profile_of(profile)
    return (treatment or f"in {found}" if found in PRIMARIES else treatment), found


def _orientation(exif: bytes) -> Orientation:
    """Return the orientation of a TIFF header with its first directory; upright without one."""
    return _turn_of(_directory(exif))


def _turn_of(tags: dict[int, tuple[int, int, int]]) -> Orientation:
    _, _, number = tags.get(ORIENTATION_TAG, (0, 0, 1))
    return Orientation(number) if 1 <= number <= 8 else Orientation.UPRIGHT


def _directory(tiff: bytes | mmap) -> dict[int, tuple[int, int, int]]:
    """Return type, count and value (or where it lies) of each tag of a TIFF's first directory."""
    if tiff[:2] not in (b"II", b"MM"):
        return {}
    ends: Literal["little", "big"] = "little" if tiff[:2] == b"II" else "big"
    at = int.from_bytes(tiff[4:8], ends)
    tags = {}
    for entry in range(int.from_bytes(tiff[at : at + 2], ends)):
        first = at + 2 + FIELD_BYTES * entry
        field = tiff[first : first + FIELD_BYTES]
        tag, kind = (int.from_bytes(field[k : k + 2], ends) for k in (0, 2))
        value = field[8:10] if kind == SHORT else field[8:12]
        tags[tag] = (kind, int.from_bytes(field[4:8], ends), int.from_bytes(value, ends))
    return tags
