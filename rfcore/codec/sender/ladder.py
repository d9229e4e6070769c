"""The ladder of accuracy and time: settings of the sender, and what each was measured to cost.

A rung is everything a sender may decide about a frame except its CRF. What the receiver must know
of it (how the field is rendered, which references) travels with each frame, so every frame may be
coded at another rung than the one before. ``rfedge eval ladder`` measures rungs and writes the file
that ``read_ladder`` reads.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfcore.codec.h264.config import PRESETS, REFERENCE_FRAMES
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field.quality import FULL, Quality

__all__ = ["FULL_RUNG", "MeasuredRung", "Rung", "front", "read_ladder"]


@dataclass(frozen=True)
class Rung:
    """One setting of the sender; raises ``InvalidInput`` for one that is not."""

    quality: Quality = FULL
    """How the field is rendered, on both ends."""
    references: int = REFERENCE_FRAMES
    """At most so many pictures are predicted from; 0: the render alone, as the paper has it."""
    photometric: bool = True
    """Whether a change of light is looked for."""
    preset: str = "medium"
    """x264's."""
    fast_unsent: bool = False
    """As in ``FrameChoice``; tables, logs and result files call it "rough"."""

    def __post_init__(self) -> None:
        if not 0 <= self.references <= REFERENCE_FRAMES:
            raise InvalidInput(
                "rung.references", f"{self.references} is outside 0..{REFERENCE_FRAMES}"
            )
        if self.preset not in PRESETS:
            raise InvalidInput("rung.preset", f"{self.preset!r} is none of {', '.join(PRESETS)}")

    @property
    def name(self) -> str:
        """The rung in words, as tables, logs and metrics show it: ``50% sh1 2ref veryfast``."""
        quality = self.quality
        parts = [f"{100 * quality.detail:g}%"]
        if quality.sh_degree is not None:
            parts.append(f"sh{quality.sh_degree}")
        if quality.samples_per_ray is not None:
            parts.append(f"{quality.samples_per_ray}samples")
        if quality.scale != 1:
            parts.append("half-size")
        parts.append(f"{self.references}ref" if self.references else "render-only")
        if not self.photometric:
            parts.append("no-light")
        if self.fast_unsent:
            parts.append("rough")
        return " ".join([*parts, self.preset])


FULL_RUNG = Rung()
"""The best there is, at the default preset."""


@dataclass(frozen=True)
class MeasuredRung:
    """A rung with its milliseconds a frame, of one thread, and its rate.

    ``rate_percent``: bits at equal quality, more (+) or fewer (-) than the ladder's first rung.
    """

    rung: Rung
    sender_ms: float
    receiver_ms: float
    rate_percent: float

    def __post_init__(self) -> None:
        for name in ("sender_ms", "receiver_ms"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidInput(f"ladder.{name}", f"{value} must be above 0 ms")
        if not math.isfinite(self.rate_percent):
            raise InvalidInput("ladder.rate_percent", f"{self.rate_percent} must be finite")


def front(rungs: Sequence[MeasuredRung]) -> tuple[MeasuredRung, ...]:
    """Return the Pareto front of time and rate, fewest bits first."""
    ordered = sorted(rungs, key=lambda rung: (rung.rate_percent, rung.sender_ms))
    kept: list[MeasuredRung] = []
    for rung in ordered:
        if not kept or rung.sender_ms < kept[-1].sender_ms:
            kept.append(rung)
    return tuple(kept)


def read_ladder(path: Path, kind: str, crf: float) -> tuple[MeasuredRung, ...]:
    """Return the front of the rungs measured for a field of ``kind`` at the CRF nearest ``crf``.

    Raises ``InvalidData`` naming the file if it is no ladder, or has nothing for such a field.
    """
    try:
        result = json.loads(path.read_text())
        if result["kind"] != "ladder":
            raise InvalidData("it is a result of another kind")
        rows = [row for row in result["rows"] if row["settings"]["kind"] == kind]
        if not rows:
            raise InvalidData(f"it has no rungs for {kind}")
        nearest = min((row["settings"]["crf"] for row in rows), key=lambda have: abs(have - crf))
        measured = [_measured(row) for row in rows if row["settings"]["crf"] == nearest]
    except (OSError, ValueError, KeyError, TypeError, InvalidInput, InvalidData) as error:
        raise InvalidData(
            f"{path}: not a usable ladder ({error!s}); make one with rfedge eval ladder"
        ) from error
    return front(measured)


def _measured(row: Mapping[str, Any]) -> MeasuredRung:
    stored = row["settings"]
    rung = Rung(
        Quality(stored["detail"], stored["sh_degree"], stored["samples_per_ray"], stored["scale"]),
        stored["references"],
        stored["photometric"],
        stored["preset"],
        fast_unsent=stored.get("rough", False),  # absent from the first ladders
    )
    return MeasuredRung(rung, row["sender_ms"], row["receiver_ms"], row["rate_percent"])
