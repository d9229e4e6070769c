"""The process that opens a camera and decodes it, and the records that it sends to the agent.

A camera that hangs leaves its reader inside a system call that only the end of the process ends (a
V4L2 driver waits without a time limit), and a stream that crashes the decoder takes its process
along. Neither may happen to the agent, so the reader is a process of its own, which the agent can
kill. In the agent, only the records of this module are used.

One thread decodes and keeps the newest frame; the main thread converts and writes it. Frames that
were superseded meanwhile, or are more than ``rate_hz`` asks for, are dropped before conversion;
so are those that rest on lost ones (``cav_agent.live.unbroken``).
The end of standard input ends the process: the agent is gone.

A record is a header of fixed size, little-endian (magic, kind, width, height, pts, received, sent,
dropped, damaged, length), then pixels or a text. Both ends are of one build and run on one machine.
The header is checked nevertheless, since the other end decodes what strangers send.
"""

from __future__ import annotations

import os
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from threading import Condition, Thread

import av
import numpy as np
from av.error import FFmpegError, InvalidDataError
from av.video.codeccontext import VideoCodecContext

from cav_agent.live.settings import ReaderSettings, SourceAddress, SourceKind
from cav_agent.live.unbroken import UnbrokenPictures
from rfcore.errors import InvalidInput, RfedgeError
from rfcore.image import Rgb, rgb_from_video_frame

NS = 1_000_000_000
PRODUCER_TIME = struct.Struct("<q")
"""``AVProducerReferenceTime.wallclock``, microseconds of the Unix epoch: from sender reports."""
KEPT_TIMES = 64
INTERLACED = (
    "each picture is two fields of two instants (interlaced); set the camera to progressive"
)
EARLY_SHARE = 0.3
"""Share of a period by which a frame may be too early and is still taken, since cameras jitter."""

MAGIC = b"RFLV"
FORMAT = struct.Struct("<4sIIIqqqqqQ")
HEADER_BYTES = FORMAT.size
FRAME, ENDED, FAILED = 1, 2, 3
UNKNOWN = -1
MAX_SIDE_PX = 8192
MAX_TEXT_BYTES = 4096


@dataclass(frozen=True)
class FrameRecord:
    """A decoded frame, uint8 [H, W, 3].

    ``pts_ns``: its presentation time, since the first frame of a file; ``None``: it has none.
    ``received_ns``: when it was decoded, Unix time. ``sender_ns``: when it was taken by the
    sender's clock, Unix time, ``None`` without a report. ``dropped``: frames left out so far;
    ``damaged``: those of them that were damaged or rest on lost ones.
    """

    rgb: Rgb
    pts_ns: int | None
    received_ns: int
    sender_ns: int | None = None
    dropped: int = 0
    damaged: int = 0

    def header(self) -> bytes:
        """Return the header; ``rgb`` follows, row by row."""
        height, width, _ = self.rgb.shape
        pts = UNKNOWN if self.pts_ns is None else self.pts_ns
        sent = UNKNOWN if self.sender_ns is None else self.sender_ns
        times = (pts, self.received_ns, sent, self.dropped, self.damaged)
        return FORMAT.pack(MAGIC, FRAME, width, height, *times, self.rgb.nbytes)


@dataclass(frozen=True)
class EndRecord:
    """The end of a source and its cause in words; ``is_whole``: a file was read to its end."""

    problem: str
    is_whole: bool = False

    def to_bytes(self) -> bytes:
        """Return header and text."""
        text = self.problem.encode()[:MAX_TEXT_BYTES]
        kind = ENDED if self.is_whole else FAILED
        return FORMAT.pack(MAGIC, kind, 0, 0, 0, 0, 0, 0, 0, len(text)) + text


Record = FrameRecord | EndRecord


@dataclass(frozen=True)
class Header:
    """A parsed header; ``length`` bytes follow it."""

    kind: int
    size_px: tuple[int, int]
    pts_ns: int
    received_ns: int
    sender_ns: int
    dropped: int
    damaged: int
    length: int

    @classmethod
    def parsed(cls, data: bytes) -> Header:
        """Return the header of ``HEADER_BYTES`` bytes; raise ``RfedgeError`` if it is none."""
        magic, kind, width, height, *rest = FORMAT.unpack(data)
        pts, received, sender, dropped, damaged, length = rest
        size_px = (width, height)
        is_frame = kind == FRAME and max(size_px) <= MAX_SIDE_PX and length == width * height * 3
        is_text = kind in (ENDED, FAILED) and length <= MAX_TEXT_BYTES
        if magic != MAGIC or not (is_frame or is_text):
            raise RfedgeError(f"the camera's reader sent a record of kind {kind}, {length} bytes")
        return cls(kind, size_px, pts, received, sender, dropped, damaged, length)


def record_of(header: Header, body: bytes | bytearray) -> Record:
    """Return the record of a header and the bytes that follow it."""
    if header.kind != FRAME:
        return EndRecord(bytes(body).decode(errors="replace"), header.kind == ENDED)
    width, height = header.size_px
    rgb = np.frombuffer(body, np.uint8).reshape(height, width, 3)
    pts_ns = None if header.pts_ns == UNKNOWN else header.pts_ns
    sender_ns = None if header.sender_ns == UNKNOWN else header.sender_ns
    times = (pts_ns, header.received_ns, sender_ns)
    return FrameRecord(rgb, *times, header.dropped, header.damaged)


@dataclass(frozen=True)
class Decoded:
    """A frame as FFmpeg gave it."""

    frame: av.VideoFrame
    pts_ns: int | None
    received_ns: int
    sender_ns: int | None

    @property
    def time_ns(self) -> int:
        """The time on the source's own clock, if it has one."""
        return self.received_ns if self.pts_ns is None else self.pts_ns


class NewestFrame:
    """Passes the newest frame from one thread to another; ``end`` closes it."""

    def __init__(self) -> None:
        self.dropped = self.damaged = 0
        self._changed = Condition()
        self._decoded: Decoded | None = None
        self._end: EndRecord | None = None

    def put(self, decoded: Decoded) -> None:
        """Offer a frame."""
        with self._changed:
            self.dropped += self._decoded is not None
            self._decoded = decoded
            self._changed.notify()

    def leave_out(self, is_damaged: bool) -> None:
        """Count a frame that is left out."""
        with self._changed:
            self.dropped += 1
            self.damaged += is_damaged

    def end(self, end: EndRecord) -> None:
        """Announce that no more frames come."""
        with self._changed:
            self._end = end
            self._changed.notify()

    def take(self) -> Decoded | EndRecord:
        """Wait for the newest frame, then for the end."""
        with self._changed:
            while self._decoded is None and self._end is None:
                self._changed.wait()
            decoded, self._decoded = self._decoded, None
            return decoded or self._end or EndRecord("")


def main() -> None:
    """Read the source that the one argument describes until it ends."""
    settings = ReaderSettings.of_json(sys.argv[1])
    Thread(target=_end_with_agent, daemon=True).start()
    newest = NewestFrame()
    Thread(target=_decode, args=(settings, newest), daemon=True).start()
    while isinstance(taken := newest.take(), Decoded):
        try:
            if taken.frame.interlaced_frame:
                raise InvalidInput("source", INTERLACED)
            rgb = rgb_from_video_frame(taken.frame, "the source")
        except RfedgeError as error:
            taken = EndRecord(str(error))
            break
        times = (taken.pts_ns, taken.received_ns, taken.sender_ns)
        record = FrameRecord(rgb, *times, newest.dropped, newest.damaged)
        _write(record.header(), rgb.data)
    _write(taken.to_bytes())
    os._exit(0)  # FFmpeg's own threads may hang with the camera


def _end_with_agent() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


def _write(*parts: bytes | memoryview) -> None:
    try:
        for part in parts:
            left = memoryview(part).cast("B")
            while left:
                left = left[os.write(1, left) :]
    except OSError:
        os._exit(1)


def _decode(settings: ReaderSettings, newest: NewestFrame) -> None:
    is_file = settings.address.is_file
    wanted = FrameDecimator(settings.rate_hz)
    try:
        for decoded in _frames(settings):
            if decoded is not None and wanted.takes(decoded.time_ns):
                newest.put(decoded)
            else:
                newest.leave_out(is_damaged=decoded is None)
        newest.end(EndRecord("the source ended", is_whole=is_file))
    except (FFmpegError, OSError, IndexError, ValueError, RfedgeError) as error:
        newest.end(EndRecord(f"{type(error).__name__}: {error}"))


class FrameDecimator:
    """Takes frames at ``rate_hz`` on average, the first one after each multiple of the period."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS / rate_hz
        self._due_ns: float | None = None

    def takes(self, time_ns: int) -> bool:
        due, period = self._due_ns, self._period_ns
        if due is None or abs(time_ns - due) > NS:  # begins, or the time stamps jump
            self._due_ns = time_ns + period
            return True
        if time_ns < due - EARLY_SHARE * period:
            return False
        self._due_ns = max(due + period, time_ns + (1 - EARLY_SHARE) * period)
        return True


def _frames(settings: ReaderSettings) -> Iterator[Decoded | None]:
    """Yield frames as they come, ``None`` for one that is damaged or rests on a lost one; those of
    a file when they are due."""
    address = settings.address
    if address.kind is SourceKind.BAG:
        yield from _frames_of_bag(address)
        return
    container = av.open(
        address.url,
        format=address.format,
        options=dict(address.options),
        timeout=settings.timeout_s,
    )
    stream = container.streams.video[0]
    context = stream.codec_context
    if not isinstance(context, VideoCodecContext):
        raise ValueError("the source is of a codec that is not known")
    # Threads by frame would delay each by as many frames; with threads by slice FFmpeg 8 does not
    # flag a picture that lacks slices.
    context.thread_count = 1
    context.flags |= av.codec.context.Flags.low_delay
    # A crop on the left is kept as the stream says, not rounded to what is fast to read.
    context.flags |= av.codec.context.Flags.unaligned
    unbroken = _unbroken(address, context)
    period_ns = PeriodOfParser(address, context)
    sent: dict[int, int] = {}
    first_pts: int | None = None
    began_ns = time.monotonic_ns()
    for packet in container.demux(stream):
        _note_sender_time(packet, sent)
        late_ns = period_ns.of(packet)
        left_out = unbroken.left_out
        frames = list(_decoded(packet, unbroken))
        yield from [None] * (unbroken.left_out - left_out)
        for frame in frames:
            pts, tick_s = frame.pts, frame.time_base or Fraction(1, 90_000)
            if pts is not None and address.kind is SourceKind.FILE:
                first_pts = pts if first_pts is None else first_pts
                pts -= first_pts
                _sleep_until(began_ns + round(pts * tick_s * NS))
            pts_ns = None if pts is None else max(0, round(pts * tick_s * NS))
            sender_ns = None if frame.pts is None else sent.get(frame.pts)
            yield Decoded(frame, pts_ns, time.time_ns() - late_ns, sender_ns)


def _frames_of_bag(address: SourceAddress) -> Iterator[Decoded | None]:
    """Yield the pictures of one topic of an MCAP file; their times are those of their stamps."""
    from rfcore.dataset.bag_records import followed_pictures

    began_ns, first_ns = time.monotonic_ns(), 0
    pictures = followed_pictures(Path(address.url), address.options.get("topic"))
    for stamp_ns, is_live, frame in pictures:
        first_ns = first_ns or stamp_ns
        if not is_live:
            _sleep_until(began_ns + stamp_ns - first_ns)
        yield Decoded(frame, stamp_ns, time.time_ns(), stamp_ns if is_live else None)


def _decoded(
    packet: av.Packet[av.VideoStream], unbroken: UnbrokenPictures[av.VideoFrame]
) -> Iterator[av.VideoFrame]:
    """Yield the frames that came out and rest on whole ones only.

    A source of which nothing can be decoded is silent to the agent.
    """
    if packet.size:
        unbroken.packet(bytes(packet), packet.pts, packet.dts, is_flagged=packet.is_corrupt)
    try:
        frames = packet.decode()
    except InvalidDataError:
        unbroken.broke()
        return
    for frame in frames:
        if isinstance(frame, av.VideoFrame):
            yield from unbroken.released(
                frame, frame.pts, is_key=frame.key_frame, is_flagged=frame.is_corrupt
            )


def _unbroken(
    address: SourceAddress, context: VideoCodecContext
) -> UnbrokenPictures[av.VideoFrame]:
    headers = bytes(context.extradata or b"")
    is_stream = context.name == "h264" and not headers.startswith(b"\x01")  # 1: of an MP4
    return UnbrokenPictures(
        has_frame_numbers=is_stream,
        may_lose=address.may_lose,
        headers=headers if is_stream else b"",
    )


class PeriodOfParser:
    """Tells how late a picture of the network is when FFmpeg gives it.

    FFmpeg's parser knows the end of a coded picture by the beginning of the next one: at 10 Hz a
    picture comes 100 ms after its last packet.
    """

    def __init__(self, address: SourceAddress, context: VideoCodecContext) -> None:
        is_network = address.kind not in (SourceKind.FILE, SourceKind.V4L2)
        self._applies = is_network and context.name in ("h264", "hevc")
        self._last_pts: int | None = None

    def of(self, packet: av.Packet[av.VideoStream]) -> int:
        """Return nanoseconds: the time from the packet before to this one, 0 if it is not known."""
        last, self._last_pts = self._last_pts, packet.pts
        if not self._applies or last is None or packet.pts is None or packet.time_base is None:
            return 0
        period_ns = round((packet.pts - last) * packet.time_base * NS)
        return period_ns if 0 < period_ns < NS else 0


def _note_sender_time(packet: av.Packet[av.VideoStream], sent: dict[int, int]) -> None:
    """Remember when the sender took a packet's picture, where RTCP sender reports say so."""
    if packet.pts is None or not packet.has_sidedata("prft"):
        return
    (wallclock_us,) = PRODUCER_TIME.unpack_from(bytes(packet.get_sidedata("prft")))
    sent[packet.pts] = wallclock_us * 1000
    while len(sent) > KEPT_TIMES:
        del sent[next(iter(sent))]


def _sleep_until(monotonic_ns: int) -> None:
    time.sleep(max(0, monotonic_ns - time.monotonic_ns()) / NS)


if __name__ == "__main__":
    main()
