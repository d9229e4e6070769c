"""What a session and the code around it exchange: decoding work, its outcome, the stream's end."""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import RfedgeError
from rfcore.wire.messages import Frame, Hello, StageTimes

__all__ = ["DecodeJob", "DecodeOutcome", "OpenJob", "StreamEnd"]


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
