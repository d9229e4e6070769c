"""A picture's way through the agent: captured, taken for encoding, encoded, answered.

Values only. ``captured_s`` and the like are seconds on the agent's monotonic clock; ``_ns`` fields
are nanoseconds of the Unix epoch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from cav_agent.rate_control import ByteBudget
from rfcore.camera import Pose
from rfcore.codec.packet import DeltaPacket
from rfcore.codec.sender.ladder import FULL_RUNG, Rung
from rfcore.views import PosedPicture
from rfcore.wire.messages import FrameAddress, StageTimes

__all__ = ["TOO_LATE", "Capture", "EncodeJob", "EncodedFrame", "FrameResult", "Outcome"]


@dataclass(frozen=True)
class Capture:
    """A picture the camera has taken; pixels are read when it is encoded."""

    index: int
    picture: PosedPicture
    captured_s: float
    capture_time_ns: int


@dataclass(frozen=True)
class EncodeJob:
    """Code ``capture`` in ``epoch``; a new epoch numbers its packets afresh.

    ``base`` is the frame it may be predicted from; ``None``: nothing but the render. ``exact``:
    whether the server's renders are ours to the bit. ``budget``: the bytes it may take;
    ``None``: the configured CRF.
    """

    capture: Capture
    epoch: int
    connection: int
    base: FrameAddress | None = None
    exact: bool = True
    budget: ByteBudget | None = None


@dataclass(frozen=True)
class EncodedFrame:
    """A coded picture; ``stage_s`` has read, convert, render, references, encode and
    closed_loop; ``tries`` is how often it was coded, to fit the payload's limit; ``rung`` is the
    setting it was coded with, ``crf`` its quality, ``pose`` the one it was coded at, if that is not
    the measured one."""

    packet: DeltaPacket
    stage_s: Mapping[str, float]
    tries: int = 1
    rung: Rung = FULL_RUNG
    crf: float | None = None
    pose: Pose | None = None


TOO_LATE = "too late"
"""Why a picture was dropped that had waited longer than its delay; a fresh one may be in time."""


class Outcome(StrEnum):
    """How a captured picture ended."""

    ACKED = "acked"
    NACKED = "nacked"
    DROPPED = "dropped"
    LOST = "lost"


@dataclass(frozen=True)
class FrameResult:
    """The end of one captured picture.

    ``reason`` is empty for an acknowledged frame. Packet, sizes and times are there as far as the
    frame got. ``latency_s`` runs from capture to answer, ``link_s`` from sending to answer without
    the server's own time.
    """

    capture: Capture
    outcome: Outcome
    reason: str = ""
    packet: DeltaPacket | None = None
    packet_bytes: int = 0
    stage_s: Mapping[str, float] = field(default_factory=dict)
    server: StageTimes | None = None
    server_digest: bytes = b""
    latency_s: float | None = None
    link_s: float | None = None
    tries: int = 1
    rung: Rung | None = None
    crf: float | None = None
    budget: ByteBudget | None = None
