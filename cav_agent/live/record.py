"""What the reader's process says to the agent: a header of fixed size, then pixels or a text.

Little-endian: magic, kind, width, height, pts, received, sent, dropped, length. Both ends are of
one build and run on one machine; the header is checked nevertheless, since the other end decodes
what strangers send.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from rfcore.errors import RfedgeError
from rfcore.image import Rgb

__all__ = ["HEADER_BYTES", "EndRecord", "FrameRecord", "Header", "Record", "record_of"]

MAGIC = b"RFLV"
FORMAT = struct.Struct("<4sIIIqqqqQ")
HEADER_BYTES = FORMAT.size
FRAME, ENDED, FAILED = 1, 2, 3
UNKNOWN = -1
MAX_SIDE_PX = 8192
MAX_TEXT_BYTES = 4096


@dataclass(frozen=True)
class FrameRecord:
    """A decoded frame, uint8 [H, W, 3].

    ``pts_ns``: its presentation time, of a file from its first frame on; ``None``: it has none.
    ``received_ns``: when it was decoded, Unix time. ``sender_ns``: when it was taken by the
    sender's clock, Unix time, ``None`` without a report. ``dropped``: frames left out so far.
    """

    rgb: Rgb
    pts_ns: int | None
    received_ns: int
    sender_ns: int | None = None
    dropped: int = 0

    def header(self) -> bytes:
        """Return the header; ``rgb`` follows, row by row."""
        height, width, _ = self.rgb.shape
        pts = UNKNOWN if self.pts_ns is None else self.pts_ns
        sent = UNKNOWN if self.sender_ns is None else self.sender_ns
        times = (pts, self.received_ns, sent, self.dropped)
        return FORMAT.pack(MAGIC, FRAME, width, height, *times, self.rgb.nbytes)


@dataclass(frozen=True)
class EndRecord:
    """The source ended, in words; ``is_whole``: a file, at its end."""

    problem: str
    is_whole: bool = False

    def to_bytes(self) -> bytes:
        """Return header and text."""
        text = self.problem.encode()[:MAX_TEXT_BYTES]
        kind = ENDED if self.is_whole else FAILED
        return FORMAT.pack(MAGIC, kind, 0, 0, 0, 0, 0, 0, len(text)) + text


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
    length: int

    @classmethod
    def parsed(cls, data: bytes) -> Header:
        """Return the header of ``HEADER_BYTES`` bytes; raise ``RfedgeError`` if it is none."""
        magic, kind, width, height, pts, received, sent, dropped, length = FORMAT.unpack(data)
        size_px = (width, height)
        is_frame = kind == FRAME and max(size_px) <= MAX_SIDE_PX and length == width * height * 3
        is_text = kind in (ENDED, FAILED) and length <= MAX_TEXT_BYTES
        if magic != MAGIC or not (is_frame or is_text):
            raise RfedgeError(f"the camera's reader sent a record of kind {kind}, {length} bytes")
        return cls(kind, size_px, pts, received, sent, dropped, length)


def record_of(header: Header, body: bytes | bytearray) -> Record:
    """Return the record of a header and the bytes that follow it."""
    if header.kind != FRAME:
        return EndRecord(bytes(body).decode(errors="replace"), header.kind == ENDED)
    width, height = header.size_px
    rgb = np.frombuffer(body, np.uint8).reshape(height, width, 3)
    pts_ns = None if header.pts_ns == UNKNOWN else header.pts_ns
    sender_ns = None if header.sender_ns == UNKNOWN else header.sender_ns
    return FrameRecord(rgb, pts_ns, header.received_ns, sender_ns, header.dropped)
