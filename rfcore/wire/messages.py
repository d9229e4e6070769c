"""The messages between vehicle and server, as plain frozen values.

The same names as in ``proto/rfcore/wire/v1/edge.proto``; ``rfcore.wire.convert`` is the only place
that knows both forms. A value of these types that came through ``convert`` has been checked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

from rfcore.camera import LATTICE, Camera, Intrinsics, Pose, PoseLattice, camera_on_rig
from rfcore.codec.h264.bitstream import StreamHeader
from rfcore.codec.packet import DeltaPacket
from rfcore.errors import RejectReason
from rfcore.field import FULL, Quality, RadianceField, Renderer, render_field_view
from rfcore.field.own import OwnField
from rfcore.localise.estimate import LocalisationState
from rfcore.views import FieldView
from rfcore.wire.conventions import RENDERER_CONTRACT
from rfcore.wire.notices import StreetNotice
from rfcore.wire.values import ClockKind

MAX_EPOCH_STEP = 1 << 16
"""Largest step from one epoch to the next: a flipped high bit must not make all later ones
stale."""

AnyPosed = TypeVar("AnyPosed", "Frame", "PoseAhead")


@dataclass(frozen=True)
class FrameAddress:
    """The frame that an answer is about."""

    camera_id: str
    epoch: int
    sequence: int


@dataclass(frozen=True)
class RendererContract:
    """Two exact renderers of one name give the same bytes for the same field and pose."""

    name: str
    exact: bool

    @staticmethod
    def of(field: RadianceField) -> RendererContract:
        """Return how this program, or the user's class, renders ``field``."""
        if isinstance(field, OwnField):
            return RendererContract(field.name, field.exact)
        return OUR_CONTRACT


OUR_CONTRACT = RendererContract(RENDERER_CONTRACT, exact=True)
"""Every archive is rendered by this one."""


@dataclass(frozen=True)
class CameraDescription:
    """One camera of a vehicle: its geometry, its coding, and its rate (0: not stated).

    With ``camera_from_rig`` the frames carry the pose of the rig, without it their camera's own.
    """

    camera_id: str
    intrinsics: Intrinsics
    codec: StreamHeader
    rate_hz: float = 0.0
    camera_from_rig: Pose | None = None

    def posed(self, frame: AnyPosed) -> AnyPosed:
        """Return ``frame`` as it came, with the pose of its camera in place of the rig's."""
        if self.camera_from_rig is None or frame.pose is None:
            return frame
        return replace(frame, pose=camera_on_rig(frame.pose, self.camera_from_rig))


@dataclass(frozen=True)
class Hello:
    """The first message of a stream.

    ``allow_recording`` says whether the server may keep more than the newest pictures,
    ``take_notices`` whether it should send notices about the street. The poses of frames are on
    ``lattice``.
    """

    vehicle_id: str
    cameras: tuple[CameraDescription, ...]
    field_ids: tuple[str, ...]
    renderer: RendererContract
    allow_recording: bool = False
    take_notices: bool = False
    lattice: PoseLattice = LATTICE


@dataclass(frozen=True)
class Frame:
    """One coded picture.

    ``pose`` is world_from_cam, tile-relative, or world_from_rig until ``CameraDescription.posed``;
    it is on the lattice of Hello (``Pose.rounded``). It is ``None`` while the camera is lost; then
    the field shows nothing to either end. ``capture_time_ns`` is sent in whole microseconds.
    Pictures of a rig with the same ``instant`` were taken together; 0 stands for a camera alone. An
    empty ``field_id`` means the first field of Hello. ``quality`` is what the vehicle rendered the
    field with, and what the server has to render it with. ``clock`` is the source of a live
    camera's ``capture_time_ns``. ``localisation`` is the state of a vehicle that finds its camera
    in the field; it is ``None`` where the pose was given.
    """

    camera_id: str
    capture_time_ns: int
    pose: Pose | None
    field_id: str
    packet: DeltaPacket
    quality: Quality = FULL
    clock: ClockKind | None = None
    localisation: LocalisationState | None = None
    instant: int = 0

    @property
    def address(self) -> FrameAddress:
        """Return camera, epoch and sequence."""
        return FrameAddress(self.camera_id, self.packet.epoch, self.packet.sequence)

    @property
    def ahead(self) -> PoseAhead:
        """Return what could be sent ahead of it."""
        return PoseAhead(
            self.camera_id,
            self.packet.epoch,
            self.packet.sequence,
            self.capture_time_ns,
            self.pose,
            self.field_id,
            self.quality,
            self.clock,
            self.localisation,
            self.instant,
        )

    def camera(self, intrinsics: Intrinsics) -> Camera | None:
        """Return the posed camera that took the picture; ``None`` if it is lost."""
        return None if self.pose is None else Camera(intrinsics, self.pose)

    def view(self, field: Renderer, intrinsics: Intrinsics) -> FieldView:
        """Return what ``field`` shows at the frame's pose; nothing if the camera is lost."""
        camera = self.camera(intrinsics)
        if camera is None:
            return FieldView.nothing(intrinsics)
        return render_field_view(field, camera, self.quality)


@dataclass(frozen=True)
class PoseAhead:
    """The part of a camera's next frame that is known before it is coded: where it was taken, and
    how the field is rendered there. Attributes are as of ``Frame``.

    ``base_digest`` names the earlier frame that it can be predicted from; empty: none.
    """

    camera_id: str
    epoch: int
    sequence: int
    capture_time_ns: int
    pose: Pose | None
    field_id: str = ""
    quality: Quality = FULL
    clock: ClockKind | None = None
    localisation: LocalisationState | None = None
    instant: int = 0
    base_digest: bytes = b""

    @property
    def address(self) -> FrameAddress:
        """Return camera, epoch and sequence of its frame."""
        return FrameAddress(self.camera_id, self.epoch, self.sequence)

    def frame(self, packet: DeltaPacket) -> Frame:
        """Return the frame, now that it is coded."""
        return Frame(
            self.camera_id,
            self.capture_time_ns,
            self.pose,
            self.field_id,
            packet,
            self.quality,
            self.clock,
            self.localisation,
            self.instant,
        )


@dataclass(frozen=True, slots=True)
class PackedFrame:
    """A frame, or a pose ahead of one, as ``rfcore.wire.head`` packs it."""

    data: bytes
    is_ahead: bool = False


@dataclass(frozen=True)
class Welcome:
    """The server accepted Hello; ``exact`` says whether the renderers agree to the bit.

    Each camera may send ``rate_hz`` pictures per second; 0 stands for as many as Credit allows.
    """

    session_id: str
    exact: bool
    rate_hz: float = 0.0


@dataclass(frozen=True)
class StageTimes:
    """Time that each stage of the server took for one frame, nanoseconds."""

    queue_ns: int = 0
    render_ns: int = 0
    splice_ns: int = 0
    decode_ns: int = 0
    total_ns: int = 0
    """From the last byte of the frame to its answer."""
    ahead_ns: int = 0
    """Before that, once its pose had come: rendering, warp and correction."""


@dataclass(frozen=True)
class Ack:
    """The frame was reconstructed; the digest is that of the server's picture, as long as the
    frame's."""

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
class DrainNotice:
    """The server is about to stop and refuses new streams; open one elsewhere, then close this."""


@dataclass(frozen=True)
class Credit:
    """Since Hello, this camera may send ``frames`` frames in all; the number never falls."""

    camera_id: str
    frames: int


ClientMessage = Hello | PoseAhead | Frame
ServerMessage = Welcome | Ack | Nack | FieldNotice | DrainNotice | StreetNotice | Credit
