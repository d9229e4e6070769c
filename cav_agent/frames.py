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
from rfcore.wire.values import ClockKind


@dataclass(frozen=True)
class Capture:
    """A picture that a camera has taken; pixels are read when it is encoded."""

    camera_id: str
    index: int
    """The picture's place on the drive."""
    picture: PosedPicture
    captured_s: float
    capture_time_ns: int
    clock: ClockKind | None = None
    """The clock that gave the time of capture of a live camera."""
    received_s: float | None = None
    """Time at which the agent had the picture of a live camera."""
    instant: int = 0
    """Pictures of a rig with the same number were taken together; 0: the camera is alone."""
    world_from_rig: Pose | None = None
    """The rig's pose in a recorded drive, rounded as it is sent."""


@dataclass(frozen=True)
class EncodeJob:
    """Code ``capture`` in ``epoch``; a new epoch numbers its packets afresh."""

    capture: Capture
    epoch: int
    connection: int
    """Counts the streams that the session has opened."""
    base: FrameAddress | None = None
    """The frame it may be predicted from; ``None``: nothing but the render."""
    exact: bool = True
    """Whether the server's renders are the vehicle's to the bit."""
    budget: ByteBudget | None = None
    """The bytes it may take; ``None``: the configured CRF."""
    started_s: float = 0.0
    """Time at which coding began."""


@dataclass(frozen=True)
class EncodedFrame:
    """A coded picture and what coding it took."""

    packet: DeltaPacket
    stage_s: Mapping[str, float]
    """Seconds by stage: convert, render (track, if poses are found), references, encode,
    closed_loop."""
    pose: Pose | None
    """The pose to send: the camera's, or its rig's; ``None`` while the camera is lost."""
    pose_state: LocalisationState | None = None
    """State of the search for the pose in the field, where that is done."""
    fix: PoseEstimate | None = None
    """The tracker's estimate, where this camera is tracked."""
    tries: int = 1
    """Number of times that it was coded to fit the payload's limit."""
    rung: Rung = FULL_RUNG
    crf: float | None = None
    read_s: float = 0.0
    """Seconds it took to load the picture from a dataset. A vehicle's camera hands its pictures
    over, so this is no stage of the sender and part of no delay."""
    waited_s: float = 0.0
    """Seconds from the arrival of a live camera's picture until it was taken to be coded."""
    field_id: str = ""
    """The field it was coded against; empty: Hello's first."""
    luma_mse: float | None = None
    """Mean squared error of the luma that the server will show."""

    @property
    def sender_s(self) -> float:
        """Seconds from the picture in memory to the packet."""
        return sum(self.stage_s.values())


class Outcome(StrEnum):
    """The end of a captured picture."""

    ACKED = "acked"
    NACKED = "nacked"
    DROPPED = "dropped"
    LOST = "lost"


class EndReason(StrEnum):
    """The reason why a picture or a stream ended: a closed set, fit for a metric's label.

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
    """The kind of failure that is tried again: a closed set, fit for a metric's label."""

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
    """Reason why a stream to a server ended; ``problem`` is for the log."""

    reason: EndReason
    problem: str


@dataclass(frozen=True)
class FrameResult:
    """The end of one captured picture; ``encoded`` and times are there as far as the frame got."""

    capture: Capture
    outcome: Outcome
    reason: EndReason | RejectReason = EndReason.NONE
    problem: str = ""
    """The cause in words."""
    encoded: EncodedFrame | None = None
    packet_bytes: int = 0
    """The whole message as sent, with the pose ahead of it."""
    ahead_bytes: int = 0
    """The pose that was sent ahead of it; 0: none was."""
    budget: ByteBudget | None = None
    session_id: str = ""
    """The stream it was encoded for."""
    server: StageTimes | None = None
    server_digest: bytes = b""
    latency_s: float | None = None
    """Seconds from capture to answer."""
    link_s: float | None = None
    """Seconds from sending to answer, without the server's own time."""

    @property
    def packet(self) -> DeltaPacket | None:
        """The coded picture, if it got so far."""
        return None if self.encoded is None else self.encoded.packet

    @property
    def stage_s(self) -> dict[str, float]:
        """Seconds by stage, with ``read`` for loading the picture; empty if it was not encoded.

        A live camera's picture also has ``receive``, from capture to arrival, and ``wait``, from
        there to coding.
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
