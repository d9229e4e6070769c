"""The options of a live camera: its address, and FFmpeg's options that open it with low delay.

==================================  ================================================================
``/dev/video0``, ``v4l2:DEVICE``    a camera of this machine, by Video4Linux2
``rtsp://``, ``rtsps://``           a camera on the network
``rtp://HOST:PORT``                 MPEG-TS in RTP, received there; HOST may be a multicast group
``udp://HOST:PORT``                 MPEG-TS alone, received there
``FILE.sdp``                        RTP as an SDP file (RFC 8866) describes it
FILE.mcap, FILE.mcap#TOPIC          pictures of an MCAP file: the newest while it is being written,
                                    else at the speed of its time stamps
any other path                      a video file, at the speed of its time stamps
==================================  ================================================================

Every kind may open the protocols it needs and no others, so that what a stream or a file says
cannot make the vehicle connect elsewhere.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from urllib.parse import urlsplit

from rfcore.errors import InvalidInput

LOW_DELAY = {"fflags": "nobuffer", "analyzeduration": "500000", "max_delay": "200000"}
"""Microseconds: probe half a second, and wait a fifth of one for RTP packets out of order."""
RTP_BUFFER_BYTES = 1 << 20
"""Buffer of the socket: a key frame of a megapixel arrives in one burst."""


class SourceKind(StrEnum):
    """The kind of a source."""

    V4L2 = "v4l2"
    RTSP = "rtsp"
    RTP = "rtp"
    MPEG_TS = "udp"
    SDP = "sdp"
    BAG = "bag"
    FILE = "file"


PROTOCOLS = {
    SourceKind.RTSP: "rtsp,rtsps,tcp,udp,rtp,tls",
    SourceKind.RTP: "rtp,udp",
    SourceKind.MPEG_TS: "udp",
    SourceKind.SDP: "file,rtp,udp",
    SourceKind.FILE: "file",
}


@dataclass(frozen=True)
class SourceAddress:
    """The ``url`` that FFmpeg opens by the demuxer ``format`` (``None``: FFmpeg finds out)."""

    kind: SourceKind
    url: str
    format: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_file(self) -> bool:
        """Return whether it is a file, whose pictures have the file's own times."""
        return self.kind in (SourceKind.FILE, SourceKind.BAG)

    @property
    def may_lose(self) -> bool:
        """Return whether packets may be lost on the way."""
        if self.kind is SourceKind.RTSP:
            return self.options.get("rtsp_transport") == RtspTransport.UDP
        return self.kind in (SourceKind.RTP, SourceKind.MPEG_TS, SourceKind.SDP)


def parse_address(text: str) -> SourceAddress:
    """Return the parsed address; raise ``InvalidInput`` naming what is expected."""
    scheme, _, rest = text.partition("://")
    if text.startswith(("/dev/video", "v4l2:")):
        device = text.removeprefix("v4l2:")
        if not device.startswith("/"):
            raise InvalidInput("source", f"'{text}' names no device such as v4l2:/dev/video0")
        return SourceAddress(SourceKind.V4L2, device, "v4l2")
    if rest and scheme in ("rtsp", "rtsps", "rtp", "udp"):
        kind = SourceKind(scheme.removesuffix("s"))
        _check_host(text, needs_port=kind is not SourceKind.RTSP)
        return _network(kind, text)
    if rest or not text.strip() or "\0" in text:
        raise InvalidInput(
            "source",
            f"'{without_password(text)}' is none of /dev/videoN, v4l2:DEVICE, rtsp://, rtsps://, "
            "rtp://HOST:PORT, udp://HOST:PORT, FILE.sdp, FILE.mcap, a video file",
        )
    path, _, topic = text.partition("#")
    if path.lower().endswith(".mcap"):
        return SourceAddress(SourceKind.BAG, path, options={"topic": topic} if topic else {})
    if text.lower().endswith(".sdp"):
        return _network(SourceKind.SDP, text)
    return SourceAddress(
        SourceKind.FILE, text, options={"protocol_whitelist": PROTOCOLS[SourceKind.FILE]}
    )


def without_password(url: str) -> str:
    """Return a URL as it may be written into a log: without user and password."""
    scheme, separator, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    host = authority.rpartition("@")[2]
    return f"{scheme}{separator}{host}{slash}{path.partition('?')[0]}" if separator else url


def _network(kind: SourceKind, url: str) -> SourceAddress:
    options = {**LOW_DELAY, "protocol_whitelist": PROTOCOLS[kind]}
    if kind in (SourceKind.RTP, SourceKind.MPEG_TS, SourceKind.SDP):
        options["buffer_size"] = str(RTP_BUFFER_BYTES)
    format_name = {SourceKind.SDP: "sdp", SourceKind.MPEG_TS: "mpegts"}.get(kind)
    return SourceAddress(kind, url, format_name, options)


def _check_host(text: str, *, needs_port: bool) -> None:
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise InvalidInput("source", f"'{without_password(text)}': {error}") from error
    if not host or (needs_port and not port):
        wanted = "HOST:PORT" if needs_port else "a host"
        raise InvalidInput("source", f"'{without_password(text)}' does not name {wanted}")


SIZE = re.compile(r"[1-9]\d{0,4}x[1-9]\d{0,4}")
WORD = re.compile(r"[a-z0-9_]{1,16}")


class RtspTransport(StrEnum):
    """The transport of RTP from an RTSP server."""

    TCP = "tcp"
    UDP = "udp"


@dataclass(frozen=True)
class LiveSettings:
    """A camera that sends now, instead of a drive's pictures."""

    source: str | None = None
    """Instead of --drive: /dev/videoN, rtsp://..., rtp://HOST:PORT, udp://HOST:PORT, FILE.sdp,
    FILE.mcap#TOPIC, or a video file (docs/how-to/cameras.md)."""
    camera_file: Path | None = None
    """The source's camera.toml: intrinsics, lens, and the trajectory if there is no --pose-feed."""
    source_timeout_s: float = 5.0
    """Seconds without a frame after which a source is lost and opened again."""
    rtsp_transport: RtspTransport = RtspTransport.TCP
    v4l2_size: str | None = None
    """WIDTHxHEIGHT requested of a V4L2 device; without it the size of camera.toml."""
    v4l2_format: str | None = None
    """Pixel format or codec requested of a V4L2 device, such as mjpeg or yuyv422."""
    v4l2_rate: float | None = None
    """Frames a second requested of a V4L2 device."""

    def __post_init__(self) -> None:
        if not 0.5 <= self.source_timeout_s <= 600:
            raise InvalidInput(
                "source_timeout_s", f"{self.source_timeout_s} s is outside 0.5..600 s"
            )
        if self.v4l2_size is not None and not SIZE.fullmatch(self.v4l2_size):
            raise InvalidInput("v4l2_size", f"'{self.v4l2_size}' is not WIDTHxHEIGHT")
        if self.v4l2_format is not None and not WORD.fullmatch(self.v4l2_format):
            raise InvalidInput("v4l2_format", f"'{self.v4l2_format}' is no name of a pixel format")
        if self.v4l2_rate is not None and not 0.1 <= self.v4l2_rate <= 1000:
            raise InvalidInput("v4l2_rate", f"{self.v4l2_rate} Hz is outside 0.1..1000 Hz")
        if self.source is None:
            return
        if self.camera_file is None:
            raise InvalidInput("camera_file", "is missing: --source needs a camera.toml")
        _ = self.address

    @property
    def address(self) -> SourceAddress:
        """The source with its options; raises ``InvalidInput`` for one that is none."""
        address = parse_address(self.source or "")
        if address.kind is SourceKind.RTSP:
            extra = {"rtsp_transport": str(self.rtsp_transport)}
            return replace(address, options={**address.options, **extra})
        return address

    def opened_for(self, size_px: tuple[int, int]) -> SourceAddress:
        """Return the address for pictures of (width, height), requested of a device."""
        address = self.address
        if address.kind is not SourceKind.V4L2:
            return address
        options = {"video_size": self.v4l2_size or f"{size_px[0]}x{size_px[1]}"}
        if self.v4l2_rate is not None:
            options["framerate"] = f"{self.v4l2_rate:g}"
        if self.v4l2_format is not None:
            options["input_format"] = self.v4l2_format
        return replace(address, options=options)


@dataclass(frozen=True)
class ReaderSettings:
    """The settings of a reader's process.

    ``timeout_s``: for opening and for each read, where FFmpeg can be interrupted.
    """

    address: SourceAddress
    timeout_s: float
    rate_hz: float

    def to_json(self) -> str:
        """Return the one argument of the process."""
        content = asdict(self)
        content["address"]["options"] = dict(self.address.options)
        return json.dumps(content)

    @staticmethod
    def of_json(text: str) -> ReaderSettings:
        """Return what ``to_json`` wrote."""
        content = json.loads(text)
        address = content.pop("address")
        address["kind"] = SourceKind(address["kind"])
        return ReaderSettings(SourceAddress(**address), **content)
