"""Codecs that a user writes: ``--method MODULE:CLASS`` beside the rivals of a comparison.

The class is a ``ClipCoder``. ``OwnCoder`` checks what it returns, names it in every error, and
depends on its source, so that what an edited module codes is never taken from finished pieces.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.image import I420
from rfcore.named_class import error_in_a_line, make_named, module_file
from rfedge.evaluate.clips import ClipCoder, CodedClip


@dataclass(frozen=True)
class OwnCoder:
    """A user's codec, checked. ``given`` is its MODULE:CLASS."""

    given: str
    coder: ClipCoder
    source: str
    """Digest of the module's file."""

    @property
    def name(self) -> str:
        """The codec's own."""
        return self.coder.name

    @property
    def points(self) -> Sequence[float]:
        """The codec's own."""
        return self.coder.points

    @property
    def limits(self) -> tuple[float, float]:
        """The codec's own; without any, its first and last point."""
        ends = (self.points[0], self.points[-1])
        return cast("tuple[float, float]", getattr(self.coder, "limits", ends))

    @property
    def version(self) -> str:
        """The codec's own, and its source."""
        return f"{self.coder.version}; source {self.source}"

    def code(self, frames: Sequence[I420], rate_hz: float, point: float) -> CodedClip:
        """Code and decode; raise ``InvalidInput`` in a line for what the codec raises, and for a
        clip that lacks frames, times or numbers."""
        try:
            coded = self.coder.code(frames, rate_hz, point)
        except Exception as error:
            problem = f"code at point {point:g} raised {error_in_a_line(error, self.given)}"
            raise InvalidInput("method", f"{self.given}: {problem}") from error
        fault = _fault(coded, len(frames))
        if fault is not None:
            raise InvalidInput("method", f"{self.given}: code at point {point:g} returned {fault}")
        return coded


def _fault(coded: object, frames: int) -> str | None:
    """Return what is wrong with a clip of so many frames, or None."""
    if not isinstance(coded, CodedClip):
        return f"{type(coded).__name__}, not a CodedClip"
    if len(coded.frame_bytes) != frames:
        return f"{len(coded.frame_bytes)} frames of {frames}; give values for every frame, in order"
    if coded.receiver_cpu_ms is None:
        return (
            "no receiver_cpu_ms; time the decoder, as examples/own_codec.py does: codecs are "
            "compared by the processor time of both ends"
        )
    for name in ("frame_bytes", "luma_mse", "cpu_ms", "receiver_cpu_ms", "ssim"):
        values = np.asarray(getattr(coded, name), np.float64)
        least = -1.0 if name == "ssim" else 0.0
        if not (np.isfinite(values) & (values >= least)).all():
            return f"{name} with values that are not finite or below {least:g}"
    return None


def own_coder(given: str) -> OwnCoder:
    """Return the codec of ``package.module:Class``; raise ``InvalidInput`` as ``make_named`` does,
    or for one that lacks a member."""
    coder = make_named("method", given)
    missing = [key for key in ("name", "points", "version", "code") if not hasattr(coder, key)]
    if missing:
        raise InvalidInput("method", f"{given!r} lacks {', '.join(missing)} of a ClipCoder")
    file = module_file(given)
    source = "built in" if file is None else hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    return OwnCoder(given, cast(ClipCoder, coder), source)
