"""Picture files of a dataset: where they are and how large, before any pixel is decoded.

Sizes come from the headers of PNG (W3C PNG, 11.2.1), JPEG (ITU-T T.81, B.2.2) and WebP (RFC 9649);
a picture of another format is measured when it is read. So a picture of a hostile size is refused
without allocating it, and a wrong size is found before a long run starts.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import BinaryIO

from rfcore.camera import MAX_SIDE_PX, Intrinsics
from rfcore.errors import DatasetError
from rfcore.image import Rgb, read_rgb
from rfcore.tables import shortened

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG", ".WEBP")
MAX_PART_BYTES = 255
"""Longest file name of Linux file systems."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_BARE = frozenset(range(0xD0, 0xD9)) | {0x01}
JPEG_SCAN = frozenset({0xDA})
JPEG_END = b"\xff\xd9"


def inside(where: str, folder: Path, name: str) -> Path:
    """Return ``folder / name``; raise ``DatasetError`` for a name that leaves the folder."""
    path = PurePosixPath(name)
    if any(len(part.encode()) > MAX_PART_BYTES for part in path.parts):
        raise DatasetError(f"{where}: path {shortened(name)} is too long")
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise DatasetError(f"{where}: path '{name}' leaves the dataset's folder {folder}")
    return folder / path


def find_picture(where: str, folder: Path, name: str) -> Path:
    """Return the file of a picture; raise ``DatasetError`` if it is missing."""
    path = picture_file(where, folder, name)
    if path is None:
        raise DatasetError(f"{where}: picture {folder / name} is missing")
    return path


def picture_file(where: str, folder: Path, name: str) -> Path | None:
    """Return the file or ``None``; a name without suffix may mean any of PNG, JPEG, WebP."""
    path = inside(where, folder, name)
    if path.is_file():
        return path
    if path.suffix not in SUFFIXES:
        for suffix in SUFFIXES:
            candidate = path.with_name(path.name + suffix)
            if candidate.is_file():
                return candidate
    return None


def read_picture(path: Path, intrinsics: Intrinsics) -> Rgb:
    """Read a picture; raise ``DatasetError`` when its size is not the camera's."""
    check_size(path, intrinsics)
    _require_length(path, intrinsics)
    _require_whole_jpeg(path)
    rgb = read_rgb(path)
    _require_size(path, (rgb.shape[1], rgb.shape[0]), intrinsics)
    return rgb


def check_size(path: Path, intrinsics: Intrinsics) -> None:
    """Raise ``DatasetError`` when the header states another size than the camera's."""
    size_px = picture_size_px(path)
    if size_px is not None:
        _require_size(path, size_px, intrinsics)


def picture_size_px(path: Path) -> tuple[int, int] | None:
    """Return (width, height) as the file's header states it, None for an unknown format."""
    try:
        with path.open("rb") as file:
            start = file.read(32)
            if start.startswith(PNG_SIGNATURE) and start[12:16] == b"IHDR":
                return int.from_bytes(start[16:20]), int.from_bytes(start[20:24])
            if start.startswith(b"\xff\xd8"):
                return _jpeg_size_px(file)
            if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
                return _webp_size_px(start)
            return None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error


def _require_size(path: Path, size_px: tuple[int, int], intrinsics: Intrinsics) -> None:
    if max(size_px) > MAX_SIDE_PX:
        raise DatasetError(
            f"{path}: picture is {size_px[0]}x{size_px[1]} px, over the limit of {MAX_SIDE_PX} px"
        )
    if size_px != (intrinsics.width_px, intrinsics.height_px):
        raise DatasetError(
            f"{path}: picture is {size_px[0]}x{size_px[1]} px, its camera says "
            f"{intrinsics.width_px}x{intrinsics.height_px}"
        )


LONGEST_PIXEL_BYTES, LONGEST_HEADER_BYTES = 8, 1 << 20
"""Four channels of 16 bits, stored; and metadata beside them."""


def _require_length(path: Path, intrinsics: Intrinsics) -> None:
    """FFmpeg, as the search for the end of a JPEG, reads the whole file at once."""
    pixels = intrinsics.width_px * intrinsics.height_px
    most_bytes, length_bytes = (
        pixels * LONGEST_PIXEL_BYTES + LONGEST_HEADER_BYTES,
        path.stat().st_size,
    )
    if length_bytes > most_bytes:
        raise DatasetError(
            f"{path}: {length_bytes} bytes are too many for {intrinsics.width_px}x"
            f"{intrinsics.height_px} px, at most {most_bytes}; save the picture anew"
        )


def _jpeg_size_px(file: BinaryIO) -> tuple[int, int] | None:
    if not _at_marker(file, JPEG_FRAMES):
        return None
    header = file.read(7)
    return int.from_bytes(header[5:7]), int.from_bytes(header[3:5])


def _require_whole_jpeg(path: Path) -> None:
    """FFmpeg fills what is missing of a JPEG with grey and reports nothing.

    In a scan 0xFF is followed by 0 or a restart marker only, so that an end marker is one.
    """
    with path.open("rb") as file:
        if file.read(2) == b"\xff\xd8" and not (
            _at_marker(file, JPEG_SCAN) and JPEG_END in file.read()
        ):
            raise DatasetError(f"{path}: truncated, the JPEG has no end marker")


def _at_marker(file: BinaryIO, wanted: frozenset[int]) -> bool:
    """Walk the marker segments from the start; stop behind the first wanted marker."""
    file.seek(2)
    while len(marker := file.read(2)) == 2 and marker[0] == 0xFF:
        if marker[1] in wanted:
            return True
        if marker[1] == 0xFF:
            file.seek(-1, 1)
        elif marker[1] not in JPEG_BARE:
            file.seek(max(int.from_bytes(file.read(2)) - 2, 0), 1)
    return False


def _webp_size_px(start: bytes) -> tuple[int, int] | None:
    kind = start[12:16]
    if kind == b"VP8X":
        width_px = int.from_bytes(start[24:27], "little") + 1
        return width_px, int.from_bytes(start[27:30], "little") + 1
    if kind == b"VP8L":
        bits = int.from_bytes(start[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        return (
            int.from_bytes(start[26:28], "little") & 0x3FFF,
            int.from_bytes(start[28:30], "little") & 0x3FFF,
        )
    return None
