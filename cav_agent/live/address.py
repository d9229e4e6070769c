"""The address of a live camera, and what FFmpeg is told to open it with low delay.

==================================  ================================================================
``/dev/video0``, ``v4l2:DEVICE``    a camera of this machine, by Video4Linux2
``rtsp://``, ``rtsps://``           a camera on the network
``rtp://HOST:PORT``                 MPEG-TS in RTP, received there; HOST may be a multicast group
``udp://HOST:PORT``                 MPEG-TS alone, received there
``FILE.sdp``                        RTP as an SDP file (RFC 8866) describes it
any other path                      a video file, at the speed of its time stamps
==================================  ================================================================

Every kind may open the protocols it needs and no others, so that what a stream or a file says
cannot make the vehicle connect elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from urllib.parse import urlsplit

from rfcore.errors import InvalidInput

__all__ = ["LOW_DELAY", "SourceAddress", "SourceKind", "parse_address", "without_password"]

LOW_DELAY = {"fflags": "nobuffer", "analyzeduration": "500000", "max_delay": "200000"}
"""Microseconds: probe half a second, and wait a fifth of one for RTP packets out of order."""
RTP_BUFFER_BYTES = 1 << 20
"""Of the socket: a key frame of a megapixel arrives in one burst."""


class SourceKind(StrEnum):
    """What a source is."""

    V4L2 = "v4l2"
    RTSP = "rtsp"
    RTP = "rtp"
    MPEG_TS = "udp"
    SDP = "sdp"
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
    """What FFmpeg opens: ``url``, by the demuxer ``format`` (``None``: it finds out)."""

    kind: SourceKind
    url: str
    format: str | None = None
    options: Mapping[str, str] = field(default_factory=dict)


def parse_address(text: str) -> SourceAddress:
    """Return what ``text`` means; raise ``InvalidInput`` naming what is expected."""
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
            "rtp://HOST:PORT, udp://HOST:PORT, FILE.sdp, a video file",
        )
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
