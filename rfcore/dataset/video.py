"""Frames of a video file by their number, in the order in which they are shown.

The file is decoded once when it is opened, since only the decoder knows which packets become
frames: edit lists hide some, AVI and raw H.264 state no times, broadcasts begin in the middle of a
group of pictures. Times are those of the frames, counted from the first one; where they are missing
or go back, frames are evenly spaced at the file's rate, which is said.

A raw stream states neither how many frames it has nor which of them is which. One that was cut
between a picture and the B pictures before it lacks these, and nothing tells.

Frames are read cheaply in order. MP4 and Matroska are sought at key frames. In other containers a
seek may end anywhere, so an earlier frame is counted from the beginning again.

A frame that does not state its colour matrix is taken as BT.709 from 720 lines up and as BT.601
below, as players do. Frames are turned and mirrored as the file says that they are shown.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import av
import numpy as np
from av.codec.context import Flags
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from rfcore.camera import MAX_SIDE_PX
from rfcore.dataset.orientation import Orientation
from rfcore.errors import DatasetError
from rfcore.image import MAX_PICTURE_PX, Rgb, rgb_from_video_frame
from rfcore.pixels import HDR, has_alpha, treatment

CONTAINERS = {
    "mov": "MP4, MOV, 3GP",
    "matroska": "MKV, WebM",
    "avi": "AVI",
    "mpegts": "MPEG-TS",
    "mpeg": "MPEG-PS",
    "flv": "FLV",
    "asf": "WMV",
    "ogg": "Ogg",
    "mxf": "MXF",
    "h264": "raw H.264",
    "hevc": "raw H.265",
    "mpegvideo": "raw MPEG-2",
    "ivf": "IVF",
    "obu": "raw AV1",
    "yuv4mpegpipe": "Y4M",
    "dv": "DV",
    "nut": "NUT",
    "gif": "GIF",
}
"""Containers that are read, by FFmpeg's names. It opens no other: playlists name other files."""
WHITELIST = ",".join(name for name in av.formats_available if name.split(",")[0] in CONTAINERS)
STILLS = ("avif", "heic", "heix", "heim", "heis", "mif1")
"""Brands of MP4 that are pictures, HEIF's."""
SOUGHT = ("mov", "matroska")
LEAST_CUT_S = 0.25
"""Sound often ends so much later than the pictures."""
TURNED_LEFT = {90: 8, 180: 3, -180: 3, -90: 6, 270: 6}
"""Orientation by a frame's rotation in degrees, counter-clockwise."""


def open_video(file: Path) -> InputContainer:
    """Open a video by its content, whatever its name; raise ``DatasetError`` if it is none."""
    try:
        container = av.open(str(file.absolute()), options={"format_whitelist": WHITELIST})
        if not container.streams.video:
            raise DatasetError(f"{file}: not a readable video (there is none in it)")
        codec = shown_stream(container).codec_context
        if isinstance(codec, VideoCodecContext):
            codec.thread_type = "AUTO"
            codec.options = {"max_pixels": str(MAX_PICTURE_PX)}
            codec.flags |= Flags.unaligned  # else a crop at the left is left out
    except (FFmpegError, OSError, ValueError) as error:
        raise DatasetError(f"{file}: not a readable video ({error})") from error
    return container


def shown_stream(container: InputContainer) -> VideoStream:
    """Return the first video stream that is no cover picture."""
    return next(
        (s for s in container.streams.video if not _is_cover(s)), container.streams.video[0]
    )


def _is_cover(stream: VideoStream) -> bool:
    return Disposition.attached_pic in stream.disposition


def is_video(path: Path) -> bool:
    """Tell whether a file is a video, by its content."""
    if not path.is_file():
        return False
    try:
        with open_video(path) as container:
            return shown_stream(container).codec_context is not None
    except DatasetError:
        return False


@dataclass(frozen=True)
class VideoIndex:
    """Everything that one pass through the file tells; sequences have an entry a frame."""

    times_ns: tuple[int, ...]
    pts: tuple[int | None, ...]
    keys: tuple[int, ...]
    """Numbers of the frames at which reading may begin: 0, and those that are sought."""
    size_px: tuple[int, int]
    """Width and height as stored."""
    orientation: Orientation
    notes: tuple[str, ...]
    """Choices and conversions, a line each."""


class Video:
    """A video file; frames are decoded when read, cheaply when they are read in order.

    Raises ``DatasetError``, naming the file, when it cannot be decoded to its end.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._lock = Lock()
        self.index = _index(file)
        self._start()

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the frames as shown."""
        return self.index.orientation.size(self.index.size_px)

    def read(self, number: int) -> Rgb:
        """Return frame ``number`` as uint8 [H, W, 3]."""
        return self.shown(self.frame(number))

    def shown(self, frame: av.VideoFrame) -> Rgb:
        """Return the pixels of a frame as they are shown."""
        return self.index.orientation.shown(rgb_from_video_frame(frame, str(self.file)))

    def frame(self, number: int) -> av.VideoFrame:
        """Return frame ``number`` as it is stored."""
        with self._lock:
            try:
                return self._frame(number)
            except (FFmpegError, StopIteration) as error:
                raise DatasetError(
                    f"{self.file}: frame {number} cannot be decoded ({error})"
                ) from error

    def _frame(self, number: int) -> av.VideoFrame:
        key = self.index.keys[bisect_right(self.index.keys, number) - 1]
        if number < self._next or key > self._next:
            self._jump(key)
        while True:
            frame = next(self._frames)
            if frame.pts != self.index.pts[self._next]:
                raise DatasetError(f"{self.file}: frame {self._next} is another than before")
            self._next += 1
            if self._next > number:
                return frame

    def _jump(self, key: int) -> None:
        """Go on at a key frame."""
        pts = self.index.pts[key]
        if key and pts is not None:
            self._container.seek(pts, stream=self._stream)
            self._frames, self._next = _frames(self._container, self._stream), key
            first = next(self._frames)
            while first.pts is not None and first.pts < pts:
                first = next(self._frames)
            if first.pts == pts:
                self._frames = _put_back(first, self._frames)
                return
        self._container.close()
        self._start()

    def _start(self) -> None:
        self._container = open_video(self.file)
        self._stream = shown_stream(self._container)
        self._frames, self._next = _frames(self._container, self._stream), 0


def _put_back(first: av.VideoFrame, rest: Iterator[av.VideoFrame]) -> Iterator[av.VideoFrame]:
    yield first
    yield from rest


def _frames(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Yield frames as they are shown; packets before the first one that can be decoded are none."""
    has_begun = False
    for packet in container.demux(stream):
        try:
            frames = packet.decode()
        except FFmpegError:
            if has_begun:
                raise
            continue
        for frame in frames:
            if isinstance(frame, av.VideoFrame):
                has_begun = True
                yield frame


def _index(file: Path) -> VideoIndex:
    pts: list[int | None] = []
    keys = [0]
    first: av.VideoFrame | None = None
    with open_video(file) as container:
        stream = shown_stream(container)
        if stream.codec_context is None:
            raise DatasetError(f"{file}: is of a codec that is not known")
        _check_side(file, stream.codec_context.width, stream.codec_context.height)
        if container.format.name.startswith("mov"):
            _require_whole_boxes(file)
        try:
            for frame in _frames(container, stream):
                first = first or frame
                _check_frame(file, len(pts), frame, first)
                if frame.key_frame and pts:
                    keys.append(len(pts))
                pts.append(frame.pts)
        except FFmpegError as error:
            raise DatasetError(
                f"{file}: frame {len(pts)} cannot be decoded ({error}); the file is cut or damaged"
            ) from error
        if first is None:
            raise DatasetError(f"{file}: holds no frames")
        times_ns, is_stated = _times_ns(file, stream, pts)
        seekable = is_stated and container.format.name.split(",")[0] in SOUGHT
        orientation = _orientation(file, first)
        notes = _notes(first, orientation)
        aspect = stream.sample_aspect_ratio
        if aspect and aspect != 1:
            notes.append(f"pixels are {float(aspect):.4g} times as wide as high: taken as stored")
        if not is_stated:
            rate = _rate_hz(file, stream, len(pts))
            notes.append(f"frames state no times in order: {float(rate):g} a second are taken")
        notes += _other_streams(container, stream)
        if (cut := _cut(container, times_ns)) is not None:
            notes.append(cut)
    size_px = (first.width, first.height)
    return VideoIndex(
        times_ns, tuple(pts), tuple(keys) if seekable else (0,), size_px, orientation, tuple(notes)
    )


def _other_streams(container: InputContainer, read: VideoStream) -> list[str]:
    """Return a line if there are other videos: a second camera, depth, a smaller copy."""
    videos = [stream for stream in container.streams.video if not _is_cover(stream)]
    sizes = [f"{s.width}x{s.height} px" for s in videos if s.index != read.index]
    if not sizes:
        return []
    return [
        f"the first of {len(sizes) + 1} videos in it, {read.width}x{read.height} px, is read; "
        f"not read: {', '.join(sizes)}"
    ]


def _check_side(file: Path, width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE_PX:
        raise DatasetError(
            f"{file}: video is {width}x{height} px, over the limit of {MAX_SIDE_PX} px"
        )


def _check_frame(file: Path, number: int, frame: av.VideoFrame, first: av.VideoFrame) -> None:
    _check_side(file, frame.width, frame.height)
    if (frame.width, frame.height) != (first.width, first.height):
        raise DatasetError(
            f"{file}: frame {number} is {frame.width}x{frame.height} px, the first one "
            f"{first.width}x{first.height}"
        )
    if frame.is_corrupt:
        raise DatasetError(f"{file}: frame {number} is damaged; cut the video before or after it")


def _require_whole_boxes(file: Path) -> None:
    """Raise ``DatasetError`` where a box of MP4 ends behind the file, which FFmpeg reads on."""
    length, at = file.stat().st_size, 0
    with file.open("rb") as content:
        while at + 8 <= length:
            content.seek(at)
            header = content.read(16)
            size = int.from_bytes(header[:4])
            size = int.from_bytes(header[8:]) if size == 1 else size or length - at
            if size < 8 or at + size > length:
                raise DatasetError(
                    f"{file}: is cut: {at + size} bytes are stated and {length} are there"
                )
            at += size


def _times_ns(
    file: Path, stream: VideoStream, pts: list[int | None]
) -> tuple[tuple[int, ...], bool]:
    """Return the frames' times from the first one, and whether the file states them."""
    stated = [tick for tick in pts if tick is not None]
    if len(stated) == len(pts) and all(a < b for a, b in pairwise(stated)):
        tick_ns = (stream.time_base or Fraction(1, 90_000)) * 1_000_000_000
        return tuple(round((tick - stated[0]) * tick_ns) for tick in stated), True
    period_ns = 1_000_000_000 / _rate_hz(file, stream, len(pts))
    return tuple(round(number * period_ns) for number in range(len(pts))), False


def _cut(container: InputContainer, times_ns: tuple[int, ...]) -> str | None:
    """Return a line if the frames end long before the length that the file states."""
    stated_s = ((container.duration or 0) - max(container.start_time or 0, 0)) / 1e6
    period_s = times_ns[-1] / 1e9 / max(len(times_ns) - 1, 1)
    shown_s = times_ns[-1] / 1e9 + period_s
    if stated_s - shown_s <= max(LEAST_CUT_S, 2 * period_s):
        return None
    return f"frames end after {shown_s:.2f} s of the {stated_s:.2f} s stated: the file may be cut"


def _rate_hz(file: Path, stream: VideoStream, count: int) -> Fraction:
    """Return the stated rate, or that of ``count`` frames in the stated length where that is less
    than half of it: an AVI copied from MP4 states its time base as its rate."""
    rate = stream.average_rate or stream.guessed_rate
    if not rate:
        raise DatasetError(f"{file}: states neither times of frames nor a rate")
    length_s = (stream.duration or 0) * (stream.time_base or Fraction(0))
    return count / length_s if 2 * count < rate * length_s else rate


def _orientation(file: Path, frame: av.VideoFrame) -> Orientation:
    try:
        matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # PyAV 18.1 does not know every kind of side data
        if frame.rotation not in TURNED_LEFT:
            return Orientation.UPRIGHT
        return Orientation(TURNED_LEFT[frame.rotation])
    if matrix is None:
        return Orientation.UPRIGHT
    return Orientation.of_display_matrix(str(file), np.frombuffer(matrix, "=i4").tolist())


def _notes(frame: av.VideoFrame, orientation: Orientation) -> list[str]:
    notes = []
    if orientation is not Orientation.UPRIGHT:
        notes.append(f"frames are {orientation.words}, as the file says")
    if (said := treatment(frame)) is not None:
        white = "; 203 cd/m2 and more is white" if said in HDR.values() else ""
        notes.append(f"{said} becomes BT.709{white}")
    if has_alpha(frame.format):
        notes.append("frames have an alpha channel: they are composed over black")
    if frame.interlaced_frame:
        notes.append("frames are marked as interlaced: what moves may show two times, line by line")
    return notes
