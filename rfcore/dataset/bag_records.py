"""Records of a bag as the confined reader hands them back, and the pictures that they hold.

A bag is an MCAP file, a bag of SQLite (``.db3``), or a folder of the files of one recording. What
is in it comes through ``rfcore.bag_reader``; only pictures (JPEG, PNG, H.264) are decoded
here, like those of any other dataset.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any, BinaryIO

import av
import numpy as np
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import Colorspace

from rfcore.bag_reader import LENGTH, NS, PICTURES, Asked, Head
from rfcore.confinement.start import confined_reader
from rfcore.dataset.bag_file import bag_files, refuse_other_bags
from rfcore.errors import BackendUnavailable, DatasetError
from rfcore.image import MAX_PICTURE_BYTES, MAX_PICTURE_PX, frame_from_bytes

MAX_LINE_BYTES = 1 << 24


def bag_records(
    path: Path, topics: Sequence[str] | None = None, *, data: bool = False, follow: bool = False
) -> Iterator[tuple[Head, bytes]]:
    """Yield records of ``topics`` (all of them), with the pictures' bytes if ``data``.

    The last one is of kind ``topics``. ``follow``: a file that is being written never ends. Raises
    ``DatasetError`` naming the file, topic and time of what is wrong.
    """
    files = bag_files(path)
    with ExitStack() as stack:
        try:
            for file in files:
                refuse_other_bags(file)
            opened = [stack.enter_context(file.open("rb")) for file in files]
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error
        chosen = None if topics is None else list(topics)
        numbered = [(file.fileno(), file.name) for file in opened]
        yield from checked(confined_records(path, opened, Asked(numbered, chosen, data, follow)))


def checked(records: Iterable[tuple[Head, bytes]]) -> Iterator[tuple[Head, bytes]]:
    """Yield records up to the last one; raise ``DatasetError`` for what the reader found wrong."""
    for head, data in records:
        if head["kind"] == "wrong":
            raise DatasetError(str(head["text"]))
        if head["kind"] != "idle":
            yield head, data
        if head["kind"] == "topics":
            return


def confined_records(
    path: Path, files: Sequence[BinaryIO], asked: Asked
) -> Iterator[tuple[Head, bytes]]:
    """Yield the records of open files, read in a process without rights."""
    words, numbers = [json.dumps(asdict(asked))], [file.fileno() for file in files]
    try:
        process, _ = confined_reader("rfcore.bag_reader", words, numbers)
    except BackendUnavailable as error:
        raise BackendUnavailable(f"no sandbox for the reader of {path} works: {error}") from error
    assert process.stdout is not None
    try:
        yield from _received(path, process.stdout)
    finally:
        process.kill()
        process.stdout.close()
        process.wait()


def _received(path: Path, answer: IO[bytes]) -> Iterator[tuple[Head, bytes]]:
    while len(prefix := answer.read(LENGTH.size)) == LENGTH.size:
        (length,) = LENGTH.unpack(prefix)
        line = answer.read(length) if length <= MAX_LINE_BYTES else b""
        try:
            head = json.loads(line)
            head["kind"], count = str(head["kind"]), int(head["bytes"])
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(f"{path}: its reader answered nonsense") from error
        data = answer.read(count) if 0 <= count <= MAX_PICTURE_BYTES else b""
        if len(data) != count:
            raise DatasetError(f"{path}: a picture of {count} bytes is above {MAX_PICTURE_BYTES}")
        yield head, data
    raise DatasetError(f"{path}: its reader was killed before the end; the bag is damaged")


CHANNELS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
"""Bytes of a pixel, and which of them are red, green and blue; alpha is left out."""
BY_FFMPEG = {
    "bayer_rggb8": ("bayer_rggb8", 1),
    "bayer_bggr8": ("bayer_bggr8", 1),
    "bayer_gbrg8": ("bayer_gbrg8", 1),
    "bayer_grbg8": ("bayer_grbg8", 1),
    "yuv422": ("uyvy422", 2),
    "uyvy": ("uyvy422", 2),
    "yuv422_yuy2": ("yuyv422", 2),
    "yuyv": ("yuyv422", 2),
}
"""FFmpeg's name of the pixels, and their bytes."""
ENCODINGS = ", ".join((*CHANNELS, *BY_FFMPEG))


def check_encoding(where: str, head: Head) -> str:
    """Return what reading does to the picture, "" for nothing; raise ``DatasetError`` by its name.

    The sizes of raw pictures are checked, too.
    """
    kind, encoding = head["kind"], str(head["encoding"])
    if kind == "video":
        if encoding != "h264":
            raise DatasetError(f"{where}: video of format '{encoding}' is not read, only h264")
        return ""
    if kind == "still":
        if "compressedDepth" in encoding or not re.search("jpe?g|png", encoding.lower()):
            raise DatasetError(f"{where}: pictures of format '{encoding}' are not read: jpeg, png")
        return ""
    if encoding not in CHANNELS and encoding not in BY_FFMPEG:
        raise DatasetError(f"{where}: encoding '{encoding}' is not read, only {ENCODINGS}")
    pixel_bytes = CHANNELS[encoding][0] if encoding in CHANNELS else BY_FFMPEG[encoding][1]
    width, height, step = int(head["width"]), int(head["height"]), int(head["step"])
    size = int(head["size"] if "size" in head else head["bytes"])
    if width < 1 or height < 1 or width * height > MAX_PICTURE_PX or step < width * pixel_bytes:
        raise DatasetError(f"{where}: {width}x{height} px of {encoding} in rows of {step} bytes")
    if size < step * height:
        raise DatasetError(f"{where}: has {size} bytes, {height} rows of {step} are stated")
    if encoding.startswith("bayer"):
        return f"are {encoding}: interpolated by FFmpeg"
    return f"are {encoding}: taken as BT.601 of limited range" if encoding in BY_FFMPEG else ""


class PictureDecoder:
    """Makes frames of a topic's records; video needs them in order, from a key frame on."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._video: VideoCodecContext | None = None
        self._heads: dict[int, Head] = {}
        self._count = 0

    def frames(self, head: Head, data: bytes) -> Iterator[tuple[Head, av.VideoFrame]]:
        """Yield the frames that are complete now, with their records."""
        where = f"{self._where}, {at_s(head)}"
        check_encoding(where, head)
        if head["kind"] == "image":
            yield head, raw_frame(head, data)
        elif head["kind"] == "still":
            yield head, frame_from_bytes(data, where)
        elif self._video is not None or head["key"]:
            self._heads[self._count] = head
            packet = av.Packet(data)
            packet.pts = packet.dts = self._count
            self._count += 1
            yield from self._decoded(where, packet)

    def end(self) -> Iterator[tuple[Head, av.VideoFrame]]:
        """Yield what a decoder of video still holds."""
        if self._video is not None:
            yield from self._decoded(self._where, None)

    def _decoded(
        self, where: str, packet: av.Packet[Any] | None
    ) -> Iterator[tuple[Head, av.VideoFrame]]:
        if self._video is None:
            context = av.CodecContext.create("h264", "r")
            assert isinstance(context, VideoCodecContext)
            context.thread_count = 1
            context.flags |= av.codec.context.Flags.low_delay
            context.options = {"max_pixels": str(MAX_PICTURE_PX)}
            self._video = context
        try:
            frames = self._video.decode(packet)
        except FFmpegError as error:
            raise DatasetError(f"{where}: H.264 cannot be decoded ({error})") from error
        for frame in frames:
            if frame.is_corrupt:
                raise DatasetError(f"{where}: H.264 is damaged; cut the bag before or after it")
            assert frame.pts is not None
            yield self._heads.pop(frame.pts), frame


def raw_frame(head: Head, data: bytes) -> av.VideoFrame:
    """Return the frame of a checked ``Image``."""
    width, height, step = (int(head[name]) for name in ("width", "height", "step"))
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)
    if head["encoding"] in CHANNELS:
        count, order = CHANNELS[head["encoding"]]
        pixels = rows[:, : width * count].reshape(height, width, count)[..., order]
        return av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), "rgb24")
    name, count = BY_FFMPEG[head["encoding"]]
    frame = av.VideoFrame(width, height, name)
    plane = frame.planes[0]
    padded = np.zeros((height, plane.line_size), np.uint8)
    padded[:, : width * count] = rows[:, : width * count]
    plane.update(padded.tobytes())
    if count == 2:
        frame.colorspace = Colorspace.ITU601
    return frame


def at_s(head: Head) -> str:
    """Return a record's time of capture, or of recording where none is stated, as text."""
    if head["stamp_ns"]:
        return f"{head['stamp_ns'] / NS:.3f} s"
    return f"log time {head['log_ns'] / NS:.3f} s"


FINISHED = b"\x89MCAP0\r\n"
"""The last bytes of an MCAP file that is written no more."""


def followed_pictures(
    path: Path, topic: str | None = None
) -> Iterator[tuple[int, bool, av.VideoFrame]]:
    """Yield time of capture, whether the file is being written, and frame of each picture.

    At the end of a file that is being written it waits for more. ``topic`` None stands for the only
    one with pictures. Raises ``DatasetError``, also for a second topic.
    """
    with path.open("rb") as file:
        file.seek(-min(len(FINISHED), path.stat().st_size), os.SEEK_END)
        is_live = file.read() != FINISHED
    decoder = PictureDecoder(f"{path}: {topic or 'its pictures'}")
    only = None if topic is None else [topic]
    for head, data in bag_records(path, only, data=True, follow=is_live):
        if head["kind"] not in PICTURES:
            continue
        topic = topic or head["topic"]
        if head["topic"] != topic:
            raise DatasetError(
                f"{path}: holds several cameras, of {topic} and {head['topic']}: name one, "
                f"{path}#{topic}"
            )
        for made_of, frame in decoder.frames(head, data):
            yield made_of["stamp_ns"] or made_of["log_ns"], is_live, frame
    if topic is None:
        raise DatasetError(f"{path}: holds no pictures")
