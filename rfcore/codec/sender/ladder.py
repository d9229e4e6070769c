"""The ladder of accuracy and time: settings of the sender, and the measured cost of each.

A rung is everything a sender may decide about a frame except its CRF. The receiver's part of it
(how the field is rendered, which references) is sent with each frame, so every frame may be coded
at another rung. ``rfedge eval ladder`` measures rungs and writes the file that ``read_ladder``
reads. A sender that finds its poses in the field also chooses an effort of tracking, whose measured
times and rates are added to a rung's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from rfcore.codec.h264.config import (
    DEFAULT_EFFORT,
    DEFAULT_REFERENCES,
    REFERENCE_FRAMES,
    Coder,
    check_effort,
    coder_of,
)
from rfcore.errors import InvalidData, InvalidInput
from rfcore.field.quality import FULL, Quality


class TrackingEffort(StrEnum):
    """The effort of finding a frame's pose in the field, for senders that do; the best first."""

    FULL = "full"
    """The field is rendered again if the pose of the first render turns out to be wrong."""
    ONCE = "once"
    """The field is rendered once."""
    HALF = "half"
    """The field is rendered once, and aligned with the frame at half the resolution or less."""

    @property
    def redraws(self) -> int:
        """Most renders beyond the first."""
        return int(self is TrackingEffort.FULL)

    @property
    def finest_level(self) -> int:
        """The finest level of the image pyramids to align; each level halves the resolution."""
        return int(self is TrackingEffort.HALF)


@dataclass(frozen=True)
class Rung:
    """One setting of the sender; raises ``InvalidInput`` for values out of range."""

    quality: Quality = FULL
    """The quality of the field's render, on both ends."""
    references: int = DEFAULT_REFERENCES
    """Most pictures to predict from; 0 is the render alone, as in the paper."""
    photometric: bool = True
    """Search for a change of light."""
    effort: str = DEFAULT_EFFORT
    """The effort of the coder."""
    tracking: TrackingEffort = TrackingEffort.FULL
    """The effort of finding the pose, for a sender that does."""

    def __post_init__(self) -> None:
        if not 0 <= self.references <= REFERENCE_FRAMES:
            raise InvalidInput(
                "rung.references", f"{self.references} is outside 0..{REFERENCE_FRAMES}"
            )
        check_effort("rung.effort", self.effort)

    @property
    def name(self) -> str:
        """The rung in words for tables, logs and metrics: ``50% sh1 2ref fast``."""
        parts = [quality_name(self.quality)]
        parts.append(f"{self.references}ref" if self.references else "render-only")
        if not self.photometric:
            parts.append("no-light")
        parts.append(self.effort)
        if self.tracking is not TrackingEffort.FULL:
            parts.append(f"track-{self.tracking}")
        return " ".join(parts)


def quality_name(quality: Quality) -> str:
    """Return the quality in words: ``50% sh1``."""
    parts = [f"{100 * quality.detail:g}%"]
    if quality.sh_degree is not None:
        parts.append(f"sh{quality.sh_degree}")
    if quality.samples_per_ray is not None:
        parts.append(f"{quality.samples_per_ray}samples")
    if quality.scale != 1:
        parts.append("half-size")
    return " ".join(parts)


FULL_RUNG = Rung()
"""The best quality, at the default effort."""


@dataclass(frozen=True)
class MeasuredRung:
    """A rung with its milliseconds a frame on one thread, and its rate.

    ``rate_percent``: how many percent more bits it takes at equal quality than the first rung.
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


def read_ladder(
    path: Path, kind: str, crf: float, coder: Coder = Coder.OWN, *, tracking: bool = False
) -> tuple[MeasuredRung, ...]:
    """Return the front of the rungs measured for a field of ``kind`` at the CRF nearest ``crf``.

    ``tracking``: the sender finds its poses in the field; each rung is combined with every effort
    of tracking that worked at its quality. Raises ``InvalidData`` naming the file if it is no
    ladder, or has nothing for such a field and coder, or no times of tracking.
    """
    try:
        result = json.loads(path.read_text())
        if result["kind"] != "ladder":
            raise InvalidData("it is a result of another kind")
        rows = [row for row in result["rows"] if _is_for(row["settings"], kind, coder)]
        if not rows:
            raise InvalidData(f"it has no rungs for {kind} with the coder {coder}")
        nearest = min((row["settings"]["crf"] for row in rows), key=lambda have: abs(have - crf))
        measured = [_measured(row) for row in rows if row["settings"]["crf"] == nearest]
        if tracking:
            tracks = [row for row in result["tracking"] if row["settings"]["kind"] == kind]
            measured = _with_tracking(measured, tracks)
    except (OSError, ValueError, KeyError, TypeError, InvalidInput, InvalidData) as error:
        raise InvalidData(
            f"{path}: not a usable ladder ({error!s}); make one with rfedge eval ladder"
        ) from error
    return front(measured)


def _is_for(stored: Mapping[str, Any], kind: str, coder: Coder) -> bool:
    """Return whether a row was measured for that kind of field and coder."""
    return stored["kind"] == kind and coder_of(stored["effort"]) is coder


def _quality(stored: Mapping[str, Any]) -> Quality:
    return Quality(
        stored["detail"], stored["sh_degree"], stored["samples_per_ray"], stored["scale"]
    )


def _with_tracking(
    rungs: Sequence[MeasuredRung], tracks: Sequence[Mapping[str, Any]]
) -> list[MeasuredRung]:
    """Return each rung with each effort of tracking at its quality: its time and rate on top."""
    made = [
        _tracked(rung, row)
        for rung in rungs
        for row in tracks
        if row.get("track_ms") is not None and _quality(row["settings"]) == rung.rung.quality
    ]
    if not made:
        raise InvalidData("it has no times of tracking, which a vehicle that localises plans with")
    return made


def _tracked(measured: MeasuredRung, row: Mapping[str, Any]) -> MeasuredRung:
    track_ms, more_percent = row["track_ms"], row["rate_percent"]
    if not (math.isfinite(track_ms) and track_ms > 0):
        raise InvalidInput("ladder.track_ms", f"{track_ms} must be above 0 ms")
    factor = (1 + measured.rate_percent / 100) * (1 + more_percent / 100)
    return replace(
        measured,
        rung=replace(measured.rung, tracking=TrackingEffort(row["tracking"])),
        sender_ms=measured.sender_ms + track_ms,
        rate_percent=100 * (factor - 1),
    )


def _measured(row: Mapping[str, Any]) -> MeasuredRung:
    stored = row["settings"]
    rung = Rung(
        _quality(stored),
        stored["references"],
        stored["photometric"],
        stored["effort"],
    )
    return MeasuredRung(rung, row["sender_ms"], row["receiver_ms"], row["rate_percent"])
