"""What a session and the code around it exchange: decoding work, its outcome, the stream's end."""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import PacketRejected, RejectReason, RfedgeError
from rfcore.wire.messages import Frame, Hello, StageTimes

__all__ = ["DecodeJob", "DecodeOutcome", "OpenJob", "RenderTooLate", "StreamEnd"]


@dataclass(frozen=True)
class OpenJob:
    """Open fields and decoders for ``hello``; ``exact``: both renderers give the same bits."""

    hello: Hello
    exact: bool


@dataclass(frozen=True)
class DecodeJob:
    """Reconstruct one frame of one camera."""

    frame: Frame
    field_id: str
    received_s: float
    started_s: float


@dataclass(frozen=True)
class DecodeOutcome:
    """A reconstructed frame: its digest and the time it took.

    ``exact`` is false when the renders differed by rounding, and with them the pictures.
    """

    reconstruction_digest: bytes
    times: StageTimes
    exact: bool = True


@dataclass(frozen=True)
class StreamEnd:
    """The stream is over; ``error`` is None when it ended as it should."""

    error: RfedgeError | None = None


class RenderTooLate(PacketRejected):
    """A frame that was not rendered, since it would have been decoded after its deadline."""

    def __init__(self, waited_s: float, expected_s: float, deadline_s: float) -> None:
        super().__init__(
            RejectReason.OVERLOADED,
            f"it waited {waited_s:.3g} s and would take {expected_s:.3g} s to render and decode; "
            f"the deadline is {deadline_s:g} s after its arrival",
        )
