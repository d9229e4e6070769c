"""Numerical work that a session hands out, and what comes back."""

from __future__ import annotations

from dataclasses import dataclass

from rfcore.errors import RfedgeError
from rfcore.wire.messages import Frame, Hello, StageTimes

__all__ = ["DecodeJob", "DecodeOutcome", "End", "OpenJob"]


@dataclass(frozen=True)
class OpenJob:
    """Prepare fields and decoders for ``hello``; ``exact`` says how strictly to compare."""

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
    """A reconstructed frame: how many before it are missing, its digest, the time it took.

    ``exact`` is false when the renders differed by rounding, and with them the pictures.
    """

    lost: int
    reconstruction_digest: bytes
    times: StageTimes
    exact: bool = True


@dataclass(frozen=True)
class End:
    """The stream is over; ``error`` is None when it ended as it should."""

    error: RfedgeError | None = None
