"""The values that follow one picture through the agent: captured, encoded, ended.

They hold no behaviour. ``captured_s`` and the like are seconds on the agent's monotonic clock;
``_ns`` fields are nanoseconds of the Unix epoch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from cav_agent.rate_control import ByteBudget
from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.sender.ladder import FULL_RUNG, Rung
from rfcore.errors import RejectReason
from rfcore.localise.estimate import LocalisationState, PoseEstimate
from rfcore.views import PosedPicture
from rfcore.wire.messages import FrameAddress, StageTimes
from rfcore.wire.sensing import ClockKind

__all__ = [
    "Capture",
    "EncodeJob",
    "EncodedFrame",
    "EndReason",
    "FrameResult",
    "Outcome",
    "RetryReason",
    "RigPose",
    "StreamEnd",
]


@dataclass(frozen=True)
class Capture:
    """A picture a camera has taken; pixels are read when it is encoded.

    Of a live camera ``clock`` says what ``captured_s`` rests on, and ``received_s`` when the agent
    had the picture.
    """

    index: int
    picture: PosedPicture
    captured_s: float
    capture_time_ns: int
    clock: ClockKind | None = None
    received_s: float | None = None
    camera_id: str = ""
    """Of a rig; empty: the vehicle's only camera."""
    instant: int = 0
    """Pictures of a rig with the same number were taken together; 0: it stands alone."""
    world_from_rig: Pose | None = None
    """Of a rig's drive, rounded as it is sent."""


@dataclass(frozen=True)
class EncodeJob:
    """Code ``capture`` in ``epoch``; a new epoch numbers its packets afresh.

    ``base`` is the frame it may be predicted from; ``None``: nothing but the render. ``exact``:
    whether the server's renders are ours to the bit. ``budget``: the bytes it may take; ``None``:
    the configured CRF. ``connection`` counts the streams the session has opened.
    ``started_s``: when it was taken to be coded.
    """

    capture: Capture
    epoch: int
    connection: int
    base: FrameAddress | None = None
    exact: bool = True
    budget: ByteBudget | None = None
    started_s: float = 0.0


@dataclass(frozen=True)
class RigPose:
    """Where a rig was when a picture was taken, rounded as it is sent; ``None``: it is lost.

    ``state``: how it was found in the field, if it is looked for there.
    """

    world_from_rig: Pose | None
    state: LocalisationState | None = None


@dataclass(frozen=True)
class EncodedFrame:
    """A coded picture and what coding it took.

    ``stage_s``: seconds by stage (convert, render, or track if poses are found, references, encode,
    closed_loop). ``tries``: how often it was coded to fit the payload's limit. ``rung``, ``crf``:
    the setting it was coded with. ``pose``: the one it was coded at; ``None``: the measured one.
    ``read_s``: seconds it took to load the picture from the dataset. A vehicle's camera hands its
    pictures over, so this is no stage of the sender and part of no delay. ``fix``: how its pose was
    found in the field, where that is done. ``waited_s``: of a live camera, from its arrival until
    it was taken to be coded. ``field_id``: the field it was coded against; empty: Hello's first.
    ``world_from_rig``: of a rig's camera, the pose to send.
    """

    packet: DeltaPacket
    stage_s: Mapping[str, float]
    tries: int = 1
    rung: Rung = FULL_RUNG
    crf: float | None = None
    pose: Pose | None = None
    read_s: float = 0.0
    fix: PoseEstimate | None = None
    waited_s: float = 0.0
    field_id: str = ""
    world_from_rig: RigPose | None = None

    @property
    def sender_s(self) -> float:
        """Seconds from the picture in memory to the packet."""
        return sum(self.stage_s.values())


class Outcome(StrEnum):
    """How a captured picture ended."""

    ACKED = "acked"
    NACKED = "nacked"
    DROPPED = "dropped"
    LOST = "lost"


class EndReason(StrEnum):
    """Why a picture, or a stream, ended as it did: a closed set, fit for a metric's label.

    A refused frame has the server's ``RejectReason`` instead. Numbers and messages belong into the
    ``problem`` beside the reason.
    """

    NONE = ""
    """Acknowledged."""
    SUPERSEDED = "superseded"
    """A newer picture took its place before it was encoded."""
    TOO_LATE = "too_late"
    """It waited longer than its delay allows; a fresh picture may be in time."""
    STOPPING = "stopping"
    NOT_CODED = "not_coded"
    """It could not be read or encoded."""
    OVERSIZE = "oversize"
    """Its slice exceeds the payload limit at the highest CRF."""
    HANDED_OVER = "handed_over"
    """Another server takes the vehicle over; it is captured again for that one."""
    NOT_SENT = "not_sent"
    """Its stream ended while it was encoded."""
    BASE_LOST = "base_lost"
    """The frame it was predicted from was not decoded."""
    NO_WELCOME = "no_welcome"
    NO_ANSWER = "no_answer"
    STREAM_LOST = "stream_lost"
    """The transport failed, or the server ended the stream with an error."""
    SERVER_CLOSED = "server_closed"
    ABANDONED = "abandoned"
    """The stream's task ended before the picture did."""


class RetryReason(StrEnum):
    """What failed and is tried again: a closed set, fit for a metric's label."""

    STREAM = "stream"
    """A stream was lost, or refused for the moment; another is opened."""
    REFUSED = "refused"
    """The server refused a vehicle that it, or another server, had welcomed before."""
    FIELD_GONE = "field_gone"
    """The server does not hold the field any more; its tiles are asked for again."""
    FIELD = "field"
    """A field could not be fetched."""
    TILES = "tiles"
    """A server did not list its tiles."""


@dataclass(frozen=True)
class StreamEnd:
    """Why a stream to a server ended; ``problem`` is for the log."""

    reason: EndReason
    problem: str


@dataclass(frozen=True)
class FrameResult:
    """The end of one captured picture; ``encoded`` and times are there as far as the frame got.

    ``reason`` is a word that can be counted, ``problem`` says more. ``packet_bytes``: the whole
    message as sent. ``latency_s``: from capture to answer; ``link_s``: from sending to answer
    without the server's own time. ``session_id``: the stream it was encoded for.
    """

    capture: Capture
    outcome: Outcome
    reason: EndReason | RejectReason = EndReason.NONE
    problem: str = ""
    encoded: EncodedFrame | None = None
    packet_bytes: int = 0
    budget: ByteBudget | None = None
    session_id: str = ""
    server: StageTimes | None = None
    server_digest: bytes = b""
    latency_s: float | None = None
    link_s: float | None = None

    @property
    def packet(self) -> DeltaPacket | None:
        """The coded picture, if it got so far."""
        return None if self.encoded is None else self.encoded.packet

    @property
    def stage_s(self) -> dict[str, float]:
        """Seconds by stage, with ``read`` for loading the picture; empty if it was not encoded.

        Of a live camera, with ``receive`` from capture to arrival, ``wait`` from there to coding.
        """
        if self.encoded is None:
            return {}
        stage_s = {"read": self.encoded.read_s, **self.encoded.stage_s}
        capture = self.capture
        if capture.received_s is None:
            return stage_s
        before = {"receive": capture.received_s - capture.captured_s}
        return before | {"wait": self.encoded.waited_s} | stage_s

    @property
    def explanation(self) -> str:
        """Reason and problem as one text."""
        return f"{self.reason}: {self.problem}" if self.problem else str(self.reason)
