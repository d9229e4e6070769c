"""The references of a frame as pictures, made alike by both ends.

What a frame may be predicted from is decided by what there is: an earlier frame for ``PREVIOUS``,
and for ``WARP`` and ``CORRECTION`` the field's depth and picture at both poses as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from rfcore.codec.references import Reference, References
from rfcore.codec.state import Past
from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.native.warp import PosedDepth, Seen, correct_i420, warp_i420

__all__ = ["Prediction"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """What both ends hold of a frame before a bit of it is sent.

    ``seen`` is the field's depth at the frame's pose, ``past`` the earlier frame to predict from.
    ``threads`` changes no picture.
    """

    render: I420
    seen: PosedDepth | None = None
    past: Past | None = None
    threads: int = 1

    @property
    def available(self) -> frozenset[Reference]:
        """Which references can be made."""
        found = {Reference.RENDER}
        if self.past is not None:
            found.add(Reference.PREVIOUS)
            if self._before is not None and self.seen is not None:
                found |= {Reference.WARP, Reference.CORRECTION}
        return frozenset(found)

    @property
    def _before(self) -> Seen | None:
        past = self.past
        if past is None or past.seen is None or past.render is None:
            return None
        return Seen(past.picture, past.seen, past.render)

    @cached_property
    def warp(self) -> I420:
        """The earlier frame at the present pose, holes filled from the render."""
        before, seen = self._carried()
        return warp_i420(before.picture, before.at, seen, self.render, self.threads)

    @cached_property
    def correction(self) -> I420:
        """The render, with most of what the earlier frame differed by from its own."""
        return correct_i420(*self._carried(), self.render, self.threads)

    def _carried(self) -> tuple[Seen, PosedDepth]:
        before, seen = self._before, self.seen
        if before is None or seen is None:
            raise InvalidInput("references", "need an earlier frame, and depth at both poses")
        return before, seen

    def picture(self, reference: Reference) -> I420:
        """Return one reference; raise ``InvalidInput`` for one that cannot be made."""
        if reference is Reference.RENDER:
            return self.render
        if reference is Reference.WARP:
            return self.warp
        if reference is Reference.CORRECTION:
            return self.correction
        if self.past is None:
            raise InvalidInput("references", "there is no earlier frame")
        return self.past.picture

    def pictures(self, references: References) -> tuple[I420, ...]:
        """Return the references in their order."""
        return tuple(self.picture(reference) for reference in references)

    def by_reference(self) -> Mapping[Reference, I420]:
        """Return every reference that can be made."""
        return {reference: self.picture(reference) for reference in sorted(self.available)}
