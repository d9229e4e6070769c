"""The pictures a frame is predicted from, and their order.

Both ends can make all of them: the field's *render* at the frame's pose; the *previous* frame as
decoded; the *warp*, the previous frame carried to the present pose by the field's depth; and the
*correction*, the render plus what the previous frame's render was found to lack, carried the same
way (``rfcore.native.warp``). A frame without references is coded by itself (intra).

The order is the one in which the decoder is fed: the last picture is reference 0, which skipped
blocks copy and whose index costs least.
"""

from __future__ import annotations

from enum import IntEnum

from rfcore.codec.h264.config import REFERENCE_FRAMES
from rfcore.errors import InvalidInput


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
