"""The state of each end between frames: sequence numbers, and frames to predict from.

A decoded frame is identified by the digest of its picture. A packet that predicts from an earlier
frame names it (``DeltaPacket.base_digest``, the first bytes of that digest), and its own
``reconstruction_digest`` identifies the frame it makes. The sender predicts from one frame at a
time, and the caller chooses it: the last one sent or, after a loss, the last one known to have been
decoded. The receiver keeps the last few, so rolling back needs no restart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView

KEPT_FRAMES = 4
"""Decoded frames a receiver keeps: two in flight, the one before them, and one spare."""


@dataclass(frozen=True, eq=False)
class Past:
    """A decoded frame that later ones may predict from.

    ``view`` is what the field shows at the frame's pose, with its render under the frame's light.
    With it the frame can be carried to another pose.
    """

    picture: I420
    view: FieldView
    known_digest: bytes | None = None
    """The picture's digest, if it was computed already."""
    plain_render: I420 | None = None
    """The field's own render, if ``view`` has it under another light."""

    @property
    def field_render(self) -> I420:
        """The field's own render, whatever the frame's light."""
        return self.view.render if self.plain_render is None else self.plain_render

    @cached_property
    def digest(self) -> bytes:
        """The digest of the picture, by which packets name the frame."""
        return self.picture.digest() if self.known_digest is None else self.known_digest


@dataclass(frozen=True)
class EncoderState:
    """The sender's state: the sequence number of its next packet within ``epoch``, and the frame
    that the packet may be predicted from, if any."""

    epoch: int
    next_sequence: int = 0
    past: Past | None = None

    def __post_init__(self) -> None:
        _require_counts(self.epoch, self.next_sequence)


@dataclass(frozen=True)
class DecoderState:
    """The receiver's state: the lowest sequence number of ``epoch`` that it still accepts, and the
    frames it keeps, newest first."""

    epoch: int
    next_sequence: int = 0
    kept: tuple[Past, ...] = ()

    def __post_init__(self) -> None:
        _require_counts(self.epoch, self.next_sequence)

    def past(self, digest: bytes) -> Past | None:
        """Return the newest kept frame whose digest begins with ``digest``, if there is one."""
        return next((past for past in self.kept if past.digest.startswith(digest)), None)

    def after(self, epoch: int, sequence: int, past: Past) -> DecoderState:
        """Return the state once the packet ``sequence`` of ``epoch`` has become ``past``."""
        kept = (past, *self.kept)[:KEPT_FRAMES]
        return DecoderState(epoch, sequence + 1, kept)


def _require_counts(epoch: int, next_sequence: int) -> None:
    for name, value in (("epoch", epoch), ("next_sequence", next_sequence)):
        if not 0 <= value < 1 << 64:
            raise InvalidInput(f"state.{name}", f"{value} is outside 0..2**64 - 1")
