"""libx264, FFmpeg's H.264 decoder, and PyAV frames; the only module of the codec that uses PyAV.

Everything that changes x264's output is set here or is an argument. Threads work on whole pictures,
never on parts of one: one picture is one slice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from fractions import Fraction
from types import MappingProxyType

import av
import numpy as np
from av.error import FFmpegError
from av.filter import Graph
from av.video.frame import PictureType
from numpy.typing import NDArray

from rfcore.codec.h264.qp_map import Region
from rfcore.errors import CodecError
from rfcore.image import I420

SIGNAL = MappingProxyType(
    {
        "colorprim": "bt709",
        "transfer": "bt709",
        "colormatrix": "bt709",
        "fullrange": "off",
        "chromaloc": "1",
    }
)
"""The colour description in every stream: ``rfcore.native.yuv`` in the terms of annex E."""


WHOLE_PICTURES = MappingProxyType({"sliced-threads": "0"})
"""Without this option the tune zerolatency divides a picture into slices, one per thread."""

QP_RANGE = 51


class PictureKind(Enum):
    """The type of a picture to encode; ``CHOSEN`` leaves it to x264."""

    CHOSEN = PictureType.NONE
    I = PictureType.I  # noqa: E741
    P = PictureType.P


@dataclass(frozen=True)
class EncoderOptions:
    """Options of one x264 encoder. ``params`` are x264's own names and are not checked here.

    With more than one of ``threads`` a picture is begun while the one before it is still coded.
    """

    size_px: tuple[int, int]
    preset: str
    crf: float
    params: Mapping[str, str] = field(default_factory=dict)
    tune: str | None = "zerolatency"
    rate_hz: int = 25
    threads: int = 1


def encode_pictures(
    options: EncoderOptions,
    pictures: Sequence[tuple[I420, PictureKind]],
    regions: Sequence[Region] = (),
) -> list[bytes]:
    """Encode a clip with a fresh encoder; return one access unit (byte stream) per picture.

    Pictures may have odd sizes; the last row and column are repeated to the options' even size.
    ``regions`` are coded finer or coarser in the last picture, which x264 does only with adaptive
    quantisation on. Access units come in coding order. Raises ``CodecError`` if x264 fails or
    returns another number of pictures.
    """
    try:
        encoder = _open_encoder(options)
        packets = []
        for index, (picture, kind) in enumerate(pictures):
            frame = video_frame(picture, options.size_px, index)
            frame.pict_type = kind.value
            if regions and index == len(pictures) - 1:
                frame = _with_regions(frame, regions)
            packets += encoder.encode(frame)
        packets += encoder.encode(None)
    except (FFmpegError, ValueError) as error:
        raise CodecError(f"x264 with {options}: {error}") from error
    if len(packets) != len(pictures):
        raise CodecError(f"x264 made {len(packets)} access units of {len(pictures)} pictures")
    return [bytes(packet) for packet in packets]


class H264Decoder:
    """A decoder that returns one picture for one access unit, at once, or raises.

    ``size_px`` is the even, cropped size the stream must have; larger pictures are refused before
    memory is allocated for them. After an error the decoder must be ``reset``, and parameter sets
    must be sent again.
    """

    def __init__(self, size_px: tuple[int, int]) -> None:
        self._size_px = size_px
        self._context = self._open()

    def reset(self) -> None:
        """Forget everything, parameter sets included."""
        self._context = self._open()

    def close(self) -> None:
        """Do nothing: the decoder holds only memory, which is freed with the object."""

    def decode(self, access_unit: bytes) -> I420:
        """Decode one access unit (byte stream) of one whole picture, or raise ``CodecError``.

        FFmpeg conceals some damage without reporting it: callers compare a digest.
        """
        return self._picture_of(self._frame(access_unit))

    def feed(self, access_unit: bytes | memoryview) -> None:
        """Decode like ``decode``, as a reference for later units: the picture is not copied."""
        self._frame(access_unit)

    def _frame(self, access_unit: bytes | memoryview) -> av.VideoFrame:
        try:
            packet = av.Packet(access_unit)  # type: ignore[arg-type]  # takes any buffer
            frames = self._context.decode(packet)
        except (FFmpegError, ValueError, MemoryError) as error:
            raise CodecError(f"H.264 decoder: {error}") from error
        if len(frames) != 1:
            raise CodecError(f"H.264 decoder returned {len(frames)} pictures for one access unit")
        self._check(frames[0])
        return frames[0]

    def decode_all(self, access_units: Sequence[bytes]) -> list[I420]:
        """Decode a stream to its end, with the pictures that the decoder had held back."""
        try:
            frames = [f for unit in access_units for f in self._context.decode(av.Packet(unit))]
            frames += self._context.decode(None)
        except (FFmpegError, ValueError, MemoryError) as error:
            raise CodecError(f"H.264 decoder: {error}") from error
        return [self._picture_of(frame) for frame in frames]

    def _picture_of(self, frame: av.VideoFrame) -> I420:
        self._check(frame)
        return picture_of(frame)

    def _check(self, frame: av.VideoFrame) -> None:
        if frame.is_corrupt:
            raise CodecError("H.264 decoder marks the picture as corrupt")
        size_px = (frame.width, frame.height)
        if size_px != self._size_px or frame.format.name != "yuv420p":
            raise CodecError(f"H.264 decoder returned {size_px} px {frame.format.name}")

    def _open(self) -> av.VideoCodecContext:
        width_px, height_px = self._size_px
        context = av.VideoCodecContext.create("h264", "r")
        context.thread_count = 1
        # FFmpeg allocates whole macroblocks in rows of 64 px.
        max_pixels = (width_px + 63) // 64 * 64 * ((height_px + 15) // 16 * 16)
        context.options = {"max_pixels": str(max_pixels), "err_detect": "explode"}
        return context


def decode_clip(size_px: tuple[int, int], access_units: Sequence[bytes]) -> list[I420]:
    """Decode a whole clip that may reorder pictures; return them in the order they are shown.

    Raises ``CodecError`` on damage, or unless there is one picture for each access unit.
    """
    decoder = H264Decoder(size_px)
    pictures = decoder.decode_all(access_units)
    if len(pictures) != len(access_units):
        raise CodecError(f"{len(access_units)} access units decoded to {len(pictures)} pictures")
    return pictures


def _open_encoder(options: EncoderOptions) -> av.VideoCodecContext:
    encoder = av.VideoCodecContext.create("libx264", "w")
    encoder.width, encoder.height = options.size_px
    encoder.pix_fmt = "yuv420p"
    encoder.time_base = Fraction(1, options.rate_hz)
    encoder.framerate = Fraction(options.rate_hz)
    encoder.thread_count = options.threads
    params = {**SIGNAL, **options.params, **({} if options.threads == 1 else WHOLE_PICTURES)}
    encoder.options = {
        "preset": options.preset,
        "crf": repr(float(options.crf)),
        "x264-params": ":".join(f"{name}={value}" for name, value in params.items()),
        **({"tune": options.tune} if options.tune else {}),
    }
    encoder.open()
    return encoder


def video_frame(
    picture: I420, size_px: tuple[int, int], index: int, pixel_format: str = "yuv420p"
) -> av.VideoFrame:
    """Return a picture as PyAV's encoders take it, the ``index``-th of its clip.

    ``size_px`` may be larger: the last row and column are repeated. ``pixel_format`` is FFmpeg's
    name of a form of 4:2:0.
    """
    frame = av.VideoFrame(*size_px, pixel_format)
    for plane, source in zip(frame.planes, picture.planes, strict=True):
        target = _plane_view(plane)
        height, width = source.shape
        target[:height, :width] = source
        target[:height, width:] = source[:, -1:]
        target[height:] = target[height - 1]
    frame.pts = index
    return frame


def picture_of(frame: av.VideoFrame) -> I420:
    """Return a copy of a decoded 4:2:0 frame."""
    y, u, v = (_plane_view(plane).copy() for plane in frame.planes)
    return I420(y, u, v)


def _with_regions(frame: av.VideoFrame, regions: Sequence[Region]) -> av.VideoFrame:
    """Return the frame with FFmpeg's regions of interest, by a chain of its ``addroi`` filters.

    The offset is given as a share of the quantiser's range, 51. 0.03 ms a region.
    """
    graph = Graph()
    last = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1)
    )
    for region in regions:
        place = f"x={region.x_px}:y={region.y_px}:w={region.width_px}:h={region.height_px}"
        filter_ = graph.add("addroi", f"{place}:qoffset={region.qp_offset}/{QP_RANGE}")
        last.link_to(filter_)
        last = filter_
    last.link_to(graph.add("buffersink"))
    graph.configure()
    graph.push(frame)
    marked = graph.pull()
    if not isinstance(marked, av.VideoFrame):
        raise CodecError("FFmpeg's addroi filter returned no picture")
    return marked


def _plane_view(plane: av.video.plane.VideoPlane) -> NDArray[np.uint8]:
    samples: NDArray[np.uint8] = np.frombuffer(memoryview(plane), np.uint8)
    samples = samples.reshape(-1, plane.line_size)
    return samples[: plane.height, : plane.width]
