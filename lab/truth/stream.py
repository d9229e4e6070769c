"""H.264 streams of which each right picture is known, and the RTP datagrams that carry them.

A picture of a stream is right if its pixels are those of a decoder that got everything. Datagrams
are RFC 3550 and, for H.264, RFC 6184: whole NAL units, and FU-A for those above ``PAYLOAD_BYTES``.
"""

from __future__ import annotations

import hashlib
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from inspect import signature
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext

from rfcore.codec.h264.bitstream import split_nals
from rfcore.errors import RfedgeError
from rfcore.image import Rgb, rgb_from_video_frame

PAYLOAD_BYTES = 900
CLOCK_HZ = 90_000
NTP_EPOCH_S = 2_208_988_800
"""Seconds from 1900, where NTP begins, to 1970."""
SSRC = 0x5EED
REPORT_EVERY = 5
"""Pictures from one sender report to the next."""
SDP = """v=0
o=- 0 0 IN IP4 127.0.0.1
s=camera
c=IN IP4 127.0.0.1
t=0 0
m=video {port} RTP/AVP 96
a=rtpmap:96 H264/90000
"""
NAME = ("the stream",) * (len(signature(rgb_from_video_frame).parameters) - 1)
"""An argument that revisions before 28 Nov 2026 do not take."""


@dataclass(frozen=True)
class Coder:
    """The way a stream is coded: ``params`` are x264's; ``crop_left_px`` is cut by the stream."""

    count: int = 90
    group: int = 15
    size_px: tuple[int, int] = (256, 144)
    pix_fmt: str = "yuv420p"
    params: str = ""
    options: tuple[tuple[str, str], ...] = (("tune", "zerolatency"),)
    crop_left_px: int = 0
    seed: int = 3
    is_read: bool = True
    """Whether its pictures can be right; those of two instants cannot, for instance."""


@dataclass(frozen=True)
class CodedStream:
    """Access units in the order of decoding, when each is shown (in periods), the number of each
    right picture by its ``digest``, and the size of the first."""

    size_px: tuple[int, int]
    packets: Sequence[bytes]
    shown_at: Sequence[int]
    right: Mapping[bytes, int]

    def __add__(self, other: CodedStream) -> CodedStream:
        first = len(self.packets)
        later = {digest: first + number for digest, number in other.right.items()}
        times = [first + at for at in other.shown_at]
        right = {**self.right, **later}
        return CodedStream(
            self.size_px, [*self.packets, *other.packets], [*self.shown_at, *times], right
        )

    def write(self, file: Path) -> None:
        """Write a Matroska file at 25 Hz, of a stream that is shown in the order of decoding."""
        data = BytesIO(b"".join(self.packets))
        with av.open(data, "r", format="h264") as units, av.open(str(file), "w") as made:
            track = made.add_stream_from_template(units.streams.video[0])
            packets = (packet for packet in units.demux() if packet.size)
            for number, packet in enumerate(packets):
                packet.stream, packet.time_base = track, Fraction(1, 25)
                packet.pts = packet.dts = number
                made.mux(packet)


def digest(rgb: Rgb) -> bytes:
    """Return what tells a picture from any other: of its size and pixels."""
    return hashlib.blake2b(rgb.tobytes(), key=f"{rgb.shape}".encode(), digest_size=16).digest()


@cache
def coded(coder: Coder) -> CodedStream:
    """Code moving noise."""
    packets = _packets(coder, coder.params)
    right: dict[bytes, int] = {}
    if coder.is_read:
        cut = f"crop-rect={coder.crop_left_px},0,0,0:"
        whole = _packets(coder, coder.params.replace(cut, "")) if coder.crop_left_px else packets
        decoder = av.CodecContext.create("h264", "r")
        frames = [frame for packet in [*whole, None] for frame in decoder.decode(packet)]
        for number, frame in enumerate(frames):
            rgb = rgb_from_video_frame(frame, *NAME)[:, coder.crop_left_px :]
            right[digest(rgb)] = number
        if len(right) != coder.count:
            raise RfedgeError(f"{len(right)} of {coder.count} pictures are distinct")
    size_px = (coder.size_px[0] - coder.crop_left_px, coder.size_px[1])
    return CodedStream(size_px, [bytes(p) for p in packets], [p.pts for p in packets], right)


def _packets(coder: Coder, params: str) -> list[Any]:
    made = av.CodecContext.create("libx264", "w")
    assert isinstance(made, VideoCodecContext)
    width, height = coder.size_px
    made.width, made.height, made.pix_fmt = width, height, coder.pix_fmt
    made.time_base, made.framerate, made.gop_size = Fraction(1, 25), Fraction(25), coder.group
    made.options = {
        "crf": "30",
        "preset": "veryfast",
        "sc_threshold": "0",
        "keyint_min": str(coder.group),
        "threads": "1",
        **dict(coder.options),
        **({"x264-params": params} if params else {}),
    }
    shape = (height // 4 + 1, (width + 2 * coder.count) // 4 + 1, 3)
    noise = np.random.default_rng(coder.seed).integers(0, 255, shape, np.uint8)
    noise = noise.repeat(4, axis=0).repeat(4, axis=1)
    packets = []
    for i in range(coder.count):
        rgb = np.ascontiguousarray(noise[:height, 2 * i : 2 * i + width])
        frame = av.VideoFrame.from_ndarray(rgb).reformat(format=coder.pix_fmt)
        frame.pts, frame.time_base = i, Fraction(1, 25)
        packets += made.encode(frame)
    return packets + made.encode(None)


@dataclass(frozen=True)
class Datagram:
    """A packet and its time: ``picture`` is the number of the access unit, ``port`` 1 for RTCP."""

    due_s: float
    data: bytes
    picture: int
    port: int = 0


Change = Callable[[list[Datagram]], list[Datagram]]


@dataclass(frozen=True)
class Sending:
    """The way a stream is sent.

    ``reports``: with sender reports, whose clock is ``step_s`` ahead from picture ``step_at`` on.
    ``first``: the first access unit that is sent.
    """

    rate_hz: float = 25.0
    reports: bool = True
    step_at: int = 1 << 30
    step_s: float = 0.0
    stamp: int = 1000
    sequence: int = 7
    first: int = 0
    change: Change = lambda sent: sent


def datagrams(stream: CodedStream, sending: Sending, began_unix_s: float) -> list[Datagram]:
    """Return the datagrams of a stream whose first picture is taken at ``began_unix_s``."""
    made, sequence = list[Datagram](), sending.sequence
    units = list(zip(stream.packets, stream.shown_at, strict=True))
    for number, (packet, shown_at) in list(enumerate(units))[sending.first :]:
        due_s = (number - sending.first) / sending.rate_hz
        taken_s = (shown_at - sending.first) / sending.rate_hz
        stamp = (sending.stamp + round(CLOCK_HZ * taken_s)) % (1 << 32)
        if sending.reports and (number - sending.first) % REPORT_EVERY == 0:
            ahead_s = sending.step_s if number >= sending.step_at else 0.0
            report = _report(began_unix_s + taken_s + ahead_s, stamp)
            made.append(Datagram(due_s, report, number, 1))
        payloads = [part for nal in split_nals(packet) for part in _payloads(nal)]
        for part, payload in enumerate(payloads):
            is_last = part == len(payloads) - 1
            header = struct.pack(">BBHII", 0x80, 96 | is_last << 7, sequence % 65536, stamp, SSRC)
            made.append(Datagram(due_s, header + payload, number))
            sequence += 1
    return sending.change(made)


def _payloads(nal: bytes) -> Iterator[bytes]:
    if len(nal) <= PAYLOAD_BYTES:
        yield nal
        return
    for at in range(1, len(nal), PAYLOAD_BYTES):
        begins, ends = (at == 1) << 7, (at + PAYLOAD_BYTES >= len(nal)) << 6
        kind = begins | ends | nal[0] & 31
        yield bytes((nal[0] & 0xE0 | 28, kind)) + nal[at : at + PAYLOAD_BYTES]


def _report(unix_s: float, stamp: int) -> bytes:
    """Return an RTCP sender report: the time stamp of a moment of NTP."""
    ntp = round((unix_s + NTP_EPOCH_S) * (1 << 32))
    return struct.pack(">BBHIQIII", 0x80, 200, 6, SSRC, ntp, stamp, 0, 0)


def send(made: Sequence[Datagram], port: int, began_s: float) -> dict[int, float]:
    """Send datagrams to 127.0.0.1 when they are due after ``began_s`` of the monotonic clock;
    return when the last one of each access unit was sent."""
    sent_s: dict[int, float] = {}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for each in made:
            time.sleep(max(0.0, began_s + each.due_s - time.monotonic()))
            sender.sendto(each.data, ("127.0.0.1", port + each.port))
            if not each.port:
                sent_s[each.picture] = time.monotonic()
    return sent_s


def without_packet(*pictures: int) -> Change:
    """Return what loses the middle packet of access units."""

    def change(sent: list[Datagram]) -> list[Datagram]:
        lost = set()
        for picture in pictures:
            of_it = [i for i, each in enumerate(sent) if each.picture == picture and not each.port]
            lost.add(of_it[len(of_it) // 2])
        return [each for i, each in enumerate(sent) if i not in lost]

    return change


def without_pictures(*pictures: int) -> Change:
    """Return what loses access units whole."""
    return lambda sent: [each for each in sent if each.port or each.picture not in pictures]


def one_in(hundred: int, seed: int) -> Change:
    """Return what loses each packet with a chance of one in so many."""
    rng = random.Random(seed)
    return lambda sent: [each for each in sent if each.port or rng.randrange(hundred)]


def swapped(sent: list[Datagram]) -> list[Datagram]:
    """Swap the first two of each four RTP packets."""
    media = [each for each in sent if not each.port]
    for i in range(0, len(media) - 1, 4):
        a, b = media[i], media[i + 1]
        media[i], media[i + 1] = replace(b, due_s=a.due_s), replace(a, due_s=b.due_s)
    return sorted([*media, *(each for each in sent if each.port)], key=lambda each: each.due_s)


def held(from_s: float, until_s: float) -> Change:
    """Return what keeps back all that is due between two times, and gives it in one burst."""

    def due(each: Datagram) -> Datagram:
        return replace(each, due_s=until_s) if from_s <= each.due_s < until_s else each

    return lambda sent: [due(each) for each in sent]
