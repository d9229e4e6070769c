"""The options of a live camera, and what its reader is told."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path

from cav_agent.live.address import SourceAddress, SourceKind, parse_address
from rfcore.errors import InvalidInput

__all__ = ["LiveSettings", "ReaderSettings", "RtspTransport"]

SIZE = re.compile(r"[1-9]\d{0,4}x[1-9]\d{0,4}")
WORD = re.compile(r"[a-z0-9_]{1,16}")


class RtspTransport(StrEnum):
    """How RTP comes from an RTSP server."""

    TCP = "tcp"
    UDP = "udp"


@dataclass(frozen=True)
class LiveSettings:
    """A camera that sends now, instead of a drive's pictures."""

    source: str | None = None
    """Instead of --drive: /dev/videoN, rtsp://..., rtp://HOST:PORT, udp://HOST:PORT, FILE.sdp, or a
    video file (docs/how-to/cameras.md)."""
    camera_file: Path | None = None
    """The source's camera.toml: intrinsics, lens, and the trajectory if there is no --pose-feed."""
    source_timeout_s: float = 5.0
    """Seconds without a frame after which a source is lost and opened again."""
    rtsp_transport: RtspTransport = RtspTransport.TCP
    v4l2_size: str | None = None
    """WIDTHxHEIGHT that a V4L2 device is asked for; without it the size of camera.toml."""
    v4l2_format: str | None = None
    """Pixel format or codec a V4L2 device is asked for, such as mjpeg or yuyv422."""
    v4l2_rate: float | None = None
    """Frames a second that a V4L2 device is asked for."""

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
        """Return the address for pictures of (width, height): a device is asked for that size."""
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
    """``timeout_s``: for opening and for each read, where FFmpeg can be interrupted."""

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
