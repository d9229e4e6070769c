"""The messages between vehicle and server, as plain frozen values.

The same names as in ``proto/rfcore/wire/v1/edge.proto``; ``rfcore.wire.convert`` is the only place
that knows both forms. A value of these types that came through ``convert`` has been checked.
"""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.camera import Camera, Intrinsics, Pose
from rfcore.codec.h264.header import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import RejectReason
from rfcore.field.quality import FULL, Quality

__all__ = [
    "Ack",
    "CameraDescription",
    "ClientMessage",
    "Credit",
    "FieldNotice",
    "Frame",
    "FrameAddress",
    "Hello",
    "Nack",
    "RendererContract",
    "ServerMessage",
    "StageTimes",
    "Welcome",
]


@dataclass(frozen=True)
class FrameAddress:
    """Which frame an answer is about."""

    camera_id: str
    epoch: int
    sequence: int


@dataclass(frozen=True)
class RendererContract:
    """Two exact renderers of one name give the same bytes for the same field and pose."""

    name: str
    exact: bool


@dataclass(frozen=True)
class CameraDescription:
    """One camera of a vehicle: its geometry, how its pictures are coded, and how many a second it
    would send (0: not stated)."""

    camera_id: str
    intrinsics: Intrinsics
    codec: StreamHeader
    rate_hz: float = 0.0


@dataclass(frozen=True)
class Hello:
    """The first message of a stream."""

    vehicle_id: str
    cameras: tuple[CameraDescription, ...]
    field_ids: tuple[str, ...]
    renderer: RendererContract


@dataclass(frozen=True)
class Frame:
    """One coded picture.

    ``pose`` is world_from_cam, tile-relative; it takes half the bytes on the wire when it is
    ``Pose.rounded``. An empty ``field_id_prefix`` means the first field of Hello. ``quality`` is
    what the vehicle rendered the field with, and what the server is to render it with.
    """

    camera_id: str
    capture_time_ns: int
    pose: Pose
    field_id_prefix: bytes
    packet: DeltaPacket
    quality: Quality = FULL

    @property
    def address(self) -> FrameAddress:
        """Return camera, epoch and sequence."""
        return FrameAddress(self.camera_id, self.packet.epoch, self.packet.sequence)

    def camera(self, intrinsics: Intrinsics) -> Camera:
        """Return the posed camera that took the picture."""
        return Camera(intrinsics, self.pose)


@dataclass(frozen=True)
class Welcome:
    """The server accepted Hello; ``exact`` says whether the renderers agree to the bit.

    Each camera may send ``rate_hz`` pictures per second; 0: as many as Credit allows.
    """

    session_id: str
    exact: bool
    rate_hz: float = 0.0


@dataclass(frozen=True)
class StageTimes:
    """Where the server's time went for one frame, nanoseconds."""

    queue_ns: int = 0
    render_ns: int = 0
    splice_ns: int = 0
    decode_ns: int = 0
    total_ns: int = 0


@dataclass(frozen=True)
class Ack:
    """The frame was reconstructed; the digest is of the server's picture."""

    address: FrameAddress
    times: StageTimes
    reconstruction_digest: bytes


@dataclass(frozen=True)
class Nack:
    """``count`` frames from ``address`` on did not become pictures.

    An empty camera id in the address means the message could not even be parsed.
    ``current_epoch`` is the server's; a sender that starts afresh goes above it.
    """

    address: FrameAddress
    reason: RejectReason
    problem: str
    count: int = 1
    last_good_sequence: int | None = None
    current_epoch: int = 0


@dataclass(frozen=True)
class FieldNotice:
    """The fields the server holds; its FieldService has the bytes."""

    field_ids: tuple[str, ...]


@dataclass(frozen=True)
class Credit:
    """Since Hello, this camera may send ``frames`` frames in all; the number never falls."""

    camera_id: str
    frames: int


ClientMessage = Hello | Frame
ServerMessage = Welcome | Ack | Nack | FieldNotice | Credit
