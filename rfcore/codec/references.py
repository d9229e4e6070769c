"""The pictures a frame is predicted from, and what each end remembers of earlier frames.

Both ends can make all of them: the field's *render* at the frame's pose; the *previous* frame as
decoded; the *warp*, the previous frame carried to the present pose by the field's depth; and the
*correction*, the render plus what the previous frame's render was found to lack, carried the same
way (``rfcore.native.warp``). A frame without references is coded by itself (intra).

The order is the one in which the decoder is fed: the last picture is reference 0, which skipped
blocks copy and whose index costs least.

Between frames each end keeps sequence numbers and frames to predict from. A decoded frame is
identified by the digest of its picture. A packet that predicts from an earlier frame names it by
the first bytes of that digest (``DeltaPacket.base_digest``), and its own ``reconstruction_digest``
identifies the frame it makes. The sender predicts from one frame at a time, and the caller chooses
it: the last one sent or, after a loss, the last one known to have been decoded. The receiver keeps
the last few, so rolling back needs no restart.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

from rfcore.codec.h264.config import REFERENCE_FRAMES
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.views import FieldView


class Reference(IntEnum):
    """A kind of reference picture. The numbers are those of the wire."""

    RENDER = 1
    PREVIOUS = 2
    WARP = 3
    CORRECTION = 4


References = tuple[Reference, ...]

INTRA: References = ()
RENDER_ONLY: References = (Reference.RENDER,)


def is_temporal(references: References) -> bool:
    """Tell whether the receiver must hold an earlier frame."""
    return references != RENDER_ONLY and any(r is not Reference.RENDER for r in references)


def check_references(references: References) -> References:
    """Return ``references``; raise ``InvalidInput`` for more than 4 or repeated ones."""
    count = len(references)
    if count > 1 and (count > REFERENCE_FRAMES or len(set(references)) != count):
        names = ", ".join(reference.name for reference in references)
        raise InvalidInput(
            "references", f"{names}: a frame has at most {REFERENCE_FRAMES} different references"
        )
    return references


def references_name(references: References) -> str:
    """Return the references in words, in their order: ``previous+render``, or ``intra``."""
    return "+".join(reference.name.lower() for reference in references) or "intra"


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
