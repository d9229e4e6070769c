"""Pictures in memory and in files.

There are two forms: RGB, uint8 [H, W, 3], of cameras and files; and ``I420``, 8-bit YUV 4:2:0 with
BT.709 coefficients and limited range, of the codec. The exact conversion between them is
``rfcore.native.yuv``. Files are read and written with PyAV, so that the services need no OpenCV.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import av
import numpy as np
import xxhash
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from rfcore.errors import DatasetError, InvalidInput
from rfcore.files import write_whole
from rfcore.pixels import EXACT_CONVERSION, Pixels, pixels_of

Rgb = NDArray[np.uint8]
Plane = NDArray[np.uint8]

SRGB_TRANSFER = 13
UNSPECIFIED_MATRIX = 2
"""ITU-T H.273's codes."""
HD_LINES = 720

JPEG_QUANTISER = "3"
"""FFmpeg's scale for MJPEG: 2 is best, 31 worst."""
GREY = 128
"""The middle level, which is grey in all three planes."""


def rgb_from_colour(colour: NDArray[np.float32]) -> Rgb:
    """Return display-referred colour [H, W, 3], nominally 0..1, as 8 bits, rounded half up."""
    return np.asarray(np.floor(np.clip(colour, 0, 1) * 255 + 0.5), np.uint8)


@dataclass(frozen=True)
class I420:
    """An 8-bit YUV 4:2:0 picture: ``y`` [H, W], ``u`` and ``v`` [ceil(H/2), ceil(W/2)].

    Raises ``InvalidInput`` when the planes do not belong together.
    """

    y: Plane
    u: Plane
    v: Plane

    def __post_init__(self) -> None:
        half = _half(self.y.shape)
        if self.u.shape != half or self.v.shape != half:
            raise InvalidInput(
                "i420", f"chroma planes {self.u.shape}, {self.v.shape} of luma {self.y.shape}"
            )
        if any(plane.dtype != np.uint8 for plane in self.planes):
            raise InvalidInput("i420", "planes must be uint8")

    @property
    def planes(self) -> tuple[Plane, Plane, Plane]:
        """The planes in storage order."""
        return (self.y, self.u, self.v)

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        return (self.y.shape[1], self.y.shape[0])

    @staticmethod
    def empty(size_px: tuple[int, int]) -> I420:
        """Return a picture of (width, height) whose samples are still to be written."""
        shape = size_px[::-1]
        return I420(*(np.empty(s, np.uint8) for s in (shape, _half(shape), _half(shape))))

    @staticmethod
    def filled(size_px: tuple[int, int], level: int = GREY) -> I420:
        """Return a picture of (width, height) with every sample at ``level``."""
        picture = I420.empty(size_px)
        for plane in picture.planes:
            plane.fill(level)
        return picture

    def cropped(self, size_px: tuple[int, int]) -> I420:
        """Return the upper left part of (width, height), which shares this picture's samples."""
        width, height = size_px
        half = tuple(map(slice, _half((height, width))))
        return I420(self.y[:height, :width], self.u[half], self.v[half])

    def dense_planes(self) -> tuple[Plane, Plane, Plane]:
        """Return the planes in contiguous memory, as kernels take them."""
        y, u, v = map(np.ascontiguousarray, self.planes)
        return y, u, v

    def packed(self) -> bytes:
        """Return the planes one after the other, each row by row without padding."""
        return b"".join(plane.tobytes() for plane in self.planes)

    @staticmethod
    def unpacked(size_px: tuple[int, int], data: bytes) -> I420:
        """Return the picture of (width, height) whose ``packed`` form is ``data``.

        Raises ``InvalidInput`` for another number of bytes.
        """
        width, height = size_px
        half = _half((height, width))
        luma, chroma = width * height, half[0] * half[1]
        if len(data) != luma + 2 * chroma:
            raise InvalidInput(
                "i420", f"{len(data)} bytes for {width}x{height} px, expected {luma + 2 * chroma}"
            )
        y, u, v = np.split(np.frombuffer(data, np.uint8), [luma, luma + chroma])
        return I420(y.reshape(height, width), u.reshape(half), v.reshape(half))

    def digest(self) -> bytes:
        """Return XXH3-128 of the size, as text "(width, height)", and the three planes.

        Equal pictures have equal 16 bytes; others differ, but for accidents of 2**-128. Who wants
        to can make two that do not: it tells damage, not forgery.
        """
        state = xxhash.xxh3_128(f"{self.size_px}".encode())
        for plane in self.dense_planes():
            state.update(plane.data)
        return state.digest()


def _half(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the shape of the chroma planes of luma [H, W]."""
    height, width = shape
    return (height + 1) // 2, (width + 1) // 2


PICTURE_FORMATS = ",".join(
    name for name in av.formats_available if name.endswith("_pipe") or name.startswith("mov,")
)
"""Formats of single pictures, AVIF among them."""
MAX_PICTURE_PX = 1 << 26
"""Most pixels of a picture file: 8192x8192, 200 MB decoded."""
MAX_PICTURE_BYTES = 8 * MAX_PICTURE_PX + (1 << 20)
"""Four channels of 16 bits, stored, and metadata."""


def read_rgb(path: Path) -> Rgb:
    """Read a picture file as uint8 [H, W, 3]; raise ``DatasetError`` if it cannot be decoded."""
    return read_pixels(path).rgb


def read_pixels(path: Path, *, primaries: int | None = None) -> Pixels:
    """Read a picture file with what is opaque of it; raise as ``read_rgb``.

    ``primaries`` (ITU-T H.273): those of its profile, which FFmpeg does not read.
    """
    frame = read_frame(path)
    if primaries is not None:
        frame.color_primaries, frame.color_trc = primaries, SRGB_TRANSFER
    return pixels_of(frame, str(path))


def rgb_from_bytes(data: bytes, source: str) -> Rgb:
    """Return a picture file's content as uint8 [H, W, 3]; raise ``DatasetError`` naming ``source``
    if it cannot be decoded."""
    return pixels_of(frame_from_bytes(data, source), source).rgb


def read_frame(path: Path) -> av.VideoFrame:
    """Return a picture file as it is stored; raise as ``read_rgb``."""
    try:
        if path.stat().st_size > MAX_PICTURE_BYTES:
            raise DatasetError(f"{path}: is above {MAX_PICTURE_BYTES} bytes; save the picture anew")
        return frame_from_bytes(path.read_bytes(), str(path))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error


def frame_from_bytes(data: bytes, source: str) -> av.VideoFrame:
    """Decode a picture by its content: a name may be a pattern, and a playlist names others.

    Raises as ``rgb_from_bytes``.
    """
    try:
        with av.open(
            BytesIO(_top_row_first(data)), "r", options={"format_whitelist": PICTURE_FORMATS}
        ) as container:
            _check_pixels(source, container.streams.video[0])
            return next(container.decode(video=0))
    except (FFmpegError, OSError, StopIteration, IndexError) as error:
        raise DatasetError(f"{source}: not a readable picture ({error})") from error


def _top_row_first(data: bytes) -> bytes:
    """Return a PFM, whose rows run from the bottom up, upside down; FFmpeg does not turn it."""
    head = re.match(rb"P([Ff])\s+(\d{1,5})\s+(\d{1,5})\s+\S+\s", data)
    if head is None:
        return data
    start, kind, width, height = head.end(), *head.groups()
    row_bytes = int(width) * (12 if kind == b"F" else 4)
    end = start + int(height) * row_bytes
    if end > len(data):
        return data
    rows = (data[at : at + row_bytes] for at in range(start, end, row_bytes))
    return data[:start] + b"".join(reversed(list(rows)))


def _check_pixels(source: str, stream: av.VideoStream) -> None:
    """Raise ``DatasetError`` for a picture above ``MAX_PICTURE_PX``, before it is decoded."""
    pixels = stream.width * stream.height
    if pixels > MAX_PICTURE_PX:
        size = f"{stream.width}x{stream.height} px"
        raise DatasetError(f"{source}: {size} is above {MAX_PICTURE_PX} pixels; scale it down")


def rgb_from_video_frame(frame: av.VideoFrame, source: str) -> Rgb:
    """Return uint8 [H, W, 3]; an unspecified colour matrix is guessed by the size, as players do.

    Raises ``DatasetError`` naming ``source`` for colours that are not read.
    """
    matrix = frame.colorspace
    if matrix == UNSPECIFIED_MATRIX:
        matrix = Colorspace.ITU709 if frame.height >= HD_LINES else Colorspace.ITU601
    return pixels_of(frame, source, matrix).rgb


def write_png(path: Path, rgb: Rgb) -> None:
    """Write uint8 [H, W, 3] as PNG; the file appears whole or not at all."""
    write_whole(path, png_bytes(rgb))


def png_bytes(rgb: Rgb, level: int | None = None) -> bytes:
    """Return uint8 [H, W, 3] as a PNG file; ``level``: of zlib, 1 to 9."""
    options = {} if level is None else {"compression_level": str(level)}
    return _encode("png", options, av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), "rgb24"))


def jpeg_bytes(rgb: Rgb, quantiser: int | None = None) -> bytes:
    """Return uint8 [H, W, 3] as a JPEG file with chroma of half size, about quality 90.

    ``quantiser``, 1 to 31, instead of that; then the bytes are the same on every machine.
    """
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), "rgb24").reformat(
        format="yuvj420p",
        dst_colorspace=Colorspace.ITU601,
        dst_color_range=ColorRange.JPEG,
        interpolation=EXACT_CONVERSION,
    )
    options = {"qmin": JPEG_QUANTISER, "qmax": JPEG_QUANTISER}
    if quantiser is not None:
        options = {"qmin": str(quantiser), "qmax": str(quantiser), "dct": "int"}
    return _encode("mjpeg", options, frame)


def _encode(codec: str, options: dict[str, str], frame: av.VideoFrame) -> bytes:
    encoder = av.CodecContext.create(codec, "w")
    assert isinstance(encoder, VideoCodecContext)
    encoder.width, encoder.height = frame.width, frame.height
    encoder.pix_fmt, encoder.options = frame.format.name, options
    encoder.time_base = Fraction(1, 1)
    packets = [*encoder.encode(frame), *encoder.encode(None)]
    return b"".join(bytes(packet) for packet in packets)
