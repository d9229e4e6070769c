"""The options of a pose feed, and where it is read from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from cav_agent.pose_feed.placing import CameraMount
from rfcore.errors import InvalidInput

__all__ = ["FeedSource", "PoseFeedSettings", "SourceKind", "parse_source"]

BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)
GPSD_PORT = 2947


class SourceKind(StrEnum):
    """Where the lines of a feed come from."""

    FILE = "file"
    UDP = "udp"
    SERIAL = "serial"
    GPSD = "gpsd"


@dataclass(frozen=True)
class FeedSource:
    """A parsed source: ``path`` of file and serial, ``host`` and ``port`` of UDP and gpsd."""

    kind: SourceKind
    path: Path = Path()
    host: str = ""
    port: int = 0
    baud: int = 9600


@dataclass(frozen=True)
class PoseFeedSettings:
    """Where the vehicle's own poses come from, instead of the drive's."""

    pose_feed: str | None = None
    """GNSS as NMEA, gpsd's JSON, or JSON lines (docs/how-to/localise.md), from file:PATH,
    udp:HOST:PORT, serial:DEVICE:BAUD or gpsd:HOST:PORT. The drive's poses are then not used."""
    camera_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The camera seen from the feed's antenna: metres forward, left, up."""
    camera_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How it is turned from looking forward: degrees of yaw left, pitch down, roll right."""
    feed_offset_s: float = 0.0
    """Add to the feed's times to get the camera's, seconds."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.feed_offset_s) and abs(self.feed_offset_s) < 1e9):
            raise InvalidInput("feed_offset_s", f"{self.feed_offset_s} is not below 1e9 s")
        _ = self.mount, self.source

    @property
    def mount(self) -> CameraMount:
        """Where the camera is on the vehicle."""
        return CameraMount(self.camera_at, self.camera_turn)

    @property
    def source(self) -> FeedSource | None:
        """The source, None where no feed is asked for."""
        return None if self.pose_feed is None else parse_source(self.pose_feed)


def parse_source(text: str) -> FeedSource:
    """Return the source of ``file:PATH`` and the like; raise ``InvalidInput`` for others."""
    kind, _, rest = text.partition(":")
    if kind == SourceKind.FILE and rest:
        return FeedSource(SourceKind.FILE, Path(rest))
    if kind == SourceKind.SERIAL and rest:
        device, _, baud = rest.partition(":")
        rate = _number(text, baud) if baud else 9600
        if rate not in BAUDS:
            raise InvalidInput("pose_feed", f"{rate} baud is none of {', '.join(map(str, BAUDS))}")
        return FeedSource(SourceKind.SERIAL, Path(device), baud=rate)
    if kind in (SourceKind.UDP, SourceKind.GPSD) and rest:
        host, colon, port = rest.rpartition(":")
        if not colon and kind == SourceKind.GPSD:
            host, port = rest, str(GPSD_PORT)
        number = _number(text, port)
        if host and 0 <= number <= 65535:
            return FeedSource(SourceKind(kind), host=host.strip("[]"), port=number)
    raise InvalidInput(
        "pose_feed",
        f"'{text}' is none of file:PATH, udp:HOST:PORT, serial:DEVICE:BAUD, gpsd:HOST:PORT",
    )


def _number(text: str, digits: str) -> int:
    if not (digits.isascii() and digits.isdecimal() and len(digits) <= 7):
        raise InvalidInput("pose_feed", f"'{text}' ends in '{digits}', not a number")
    return int(digits)
