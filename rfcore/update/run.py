"""One update of a field: learn from passes, try on frames held back, keep it if bits fall."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.update.colours import ColourFit, colour_layer
from rfcore.update.passes import Pass, SeenFrame, check_passes, split_frames
from rfcore.update.splats import FineTuning, Progress, fine_tuned
from rfcore.update.trial import saved_percent, try_field

__all__ = ["LearnAs", "Update", "UpdateSettings", "learn"]


class LearnAs(StrEnum):
    """What an update makes: another field, or the colours of one light on the same field."""

    ALL = "all"
    COLOURS = "colours"


@dataclass(frozen=True)
class UpdateSettings:
    """How an update is made and judged."""

    learn_as: LearnAs = LearnAs.ALL
    frames: int = 48
    """Most frames taken from all passes."""
    min_identities: int = 2
    """From fewer vehicles nothing is learnt."""
    min_saved_percent: float = 2.0
    """Bits must fall by so much on the frames held back."""
    max_loss_percent: float = 2.0
    """For no pass may bits rise by more."""
    fine_tuning: FineTuning = field(default_factory=FineTuning)
    colours: ColourFit = field(default_factory=ColourFit)

    def __post_init__(self) -> None:
        if not 8 <= self.frames <= 10_000:
            raise InvalidInput("update.frames", f"{self.frames} is outside 8..10000")
        if self.min_identities < 1:
            raise InvalidInput("update.min_identities", f"{self.min_identities} is below 1")


@dataclass(frozen=True)
class Update:
    """What was learnt, and by how many percent fewer bits each pass then takes."""

    learnt: SplatField
    saved_percent: dict[str, float]
    frames: int
    refused: str = ""
    """Why it is not to be kept; empty if it is."""

    @property
    def mean_saved_percent(self) -> float:
        """The mean over the passes."""
        return float(np.mean(list(self.saved_percent.values())))


def learn(
    base: RadianceField,
    passes: Sequence[Pass],
    settings: UpdateSettings,
    progress: Progress | None = None,
) -> Update:
    """Return what ``passes``, of one light, teach about ``base``, and whether it pays.

    Raises ``InvalidInput`` for a field that is no splats, or passes of too few vehicles or frames,
    ``DatasetError`` for a picture that cannot be read.
    """
    if not isinstance(base, SplatField):
        raise InvalidInput("field", f"{base.metadata.kind} cannot be updated, only splats")
    check_passes(passes, settings.min_identities)
    learnt, held_back = split_frames(passes, settings.frames)
    made = _made(base, learnt, settings, progress)
    before, after = try_field(base, held_back), try_field(made, held_back)
    saved = saved_percent(before, after)
    named = {f"{n + 1} {passes[n].identity}": percent for n, percent in saved.items()}
    update = Update(made, named, len(learnt) + len(held_back))
    return replace(update, refused=_refusal(update, settings))


def _made(
    base: SplatField,
    frames: Sequence[SeenFrame],
    settings: UpdateSettings,
    progress: Progress | None,
) -> SplatField:
    if settings.learn_as is LearnAs.COLOURS:
        made = colour_layer(base, frames, settings.colours, progress)
    else:
        made = fine_tuned(base, frames, settings.fine_tuning, progress)
        made = made.described(replace(made.metadata, training_digest=_digest(base, frames)))
        made = made.compressed()
    return made


def _digest(base: SplatField, frames: Sequence[SeenFrame]) -> str:
    digest = hashlib.sha256(base.field_id.encode())
    for frame in frames:
        digest.update(repr(frame.camera).encode())
        digest.update(np.ascontiguousarray(frame.rgb).data)
    return digest.hexdigest()


def _refusal(update: Update, settings: UpdateSettings) -> str:
    worst = min(update.saved_percent, key=lambda name: update.saved_percent[name])
    if update.saved_percent[worst] < -settings.max_loss_percent:
        return f"bits rise by {-update.saved_percent[worst]:.1f} % for pass {worst}"
    if update.mean_saved_percent < settings.min_saved_percent:
        return (
            f"bits fall by {update.mean_saved_percent:.1f} %, "
            f"less than {settings.min_saved_percent:g} %"
        )
    return ""
