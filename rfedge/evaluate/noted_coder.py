"""A coder of clips that notes more of each decoded picture than the PSNR and the SSIM.

What is noted is up to a ``FrameNotes``: LPIPS, errors by class, a detector's boxes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rfcore.image import I420
from rfedge.evaluate.clips import BoundCoder, ClipCoder, CodedClip, Notes
from rfedge.evaluate.performance import BoundedCoder
from rfedge.evaluate.rivals import CodedPictures


@runtime_checkable
class PictureCoder(ClipCoder, BoundedCoder, Protocol):
    """A coder of clips that also shows the pictures that it decodes."""

    def pictures(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedPictures:
        """Code and decode ``frames`` with low delay."""


class FrameNotes(Protocol):
    """Notes on the decoded pictures of a clip."""

    @property
    def version(self) -> str:
        """Everything that the notes depend on besides the pictures."""

    def of_run(self, run: slice) -> FrameNotes:
        """Return the notes of the frames ``run`` alone."""

    def of(self, decoded: Sequence[I420], frames: Sequence[I420]) -> Mapping[str, Notes]:
        """Return the notes by name; ``frames``, the camera's, may be the beginning of the clip."""


@dataclass(frozen=True)
class NotedCoder:
    """A coder whose clips have ``noted`` in their notes."""

    coder: PictureCoder
    noted: FrameNotes

    @property
    def name(self) -> str:
        """The coder's own."""
        return self.coder.name

    @property
    def points(self) -> Sequence[float]:
        """The coder's own."""
        return self.coder.points

    @property
    def limits(self) -> tuple[float, float]:
        """The coder's own."""
        return self.coder.limits

    @property
    def version(self) -> str:
        """The coder's own, and that of the notes."""
        return f"{self.coder.version}; {self.noted.version}"

    def of_run(self, run: slice) -> NotedCoder:
        """Return the coder of the frames ``run`` alone."""
        coder = self.coder.of_run(run) if isinstance(self.coder, BoundCoder) else self.coder
        assert isinstance(coder, PictureCoder), "a part of a coder can do what the whole can"
        return NotedCoder(coder, self.noted.of_run(run))

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode ``frames``, which may be the beginning of those of the notes."""
        made = self.coder.pictures(frames, rate_hz, point)
        return made.measured(point, frames, **self.noted.of(made.decoded, frames))
