"""One update of a field: learn from passes, try on frames held back, keep it if bits fall."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import count

import numpy as np

from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.delta import check_base, delta_of
from rfcore.update.agreement import without_outliers
from rfcore.update.colours import ColourFit, colour_layer
from rfcore.update.passes import Pass, SeenFrame, check_passes, split_frames
from rfcore.update.splats import FineTuning, Progress, fine_tuned
from rfcore.update.trial import TRIAL_CRFS, saved_percent, try_field

__all__ = ["LearnAs", "Update", "UpdateSettings", "learn", "learn_from"]


class LearnAs(StrEnum):
    """What an update makes: another field; the same, stored as its difference to the base
    (``rfcore.field.delta``); or the colours of one light on the same field."""

    ALL = "all"
    DELTA = "delta"
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
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames of each identity that were outliers and taught nothing."""

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
    """Return what ``passes``, of one light, teach about ``base`` without their outliers.

    Raises as ``learn_from`` does, saying how many frames were dropped where too few are left.
    """
    check_passes(passes, settings.min_identities)
    honest = without_outliers(base, passes)
    dropped = _dropped(passes, honest)
    try:
        check_passes(honest, settings.min_identities)
    except InvalidInput as error:
        left_out = ", ".join(f"{count} of {name}" for name, count in dropped.items())
        raise InvalidInput(
            "from",
            f"{error}; left out are frames whose edges lie neither where the field's do nor where "
            f"another pass has some: {left_out}. Look at them with `rfedge field disagree`",
        ) from error
    return replace(learn_from(base, honest, settings, progress), dropped=dropped)


def learn_from(
    base: RadianceField,
    passes: Sequence[Pass],
    settings: UpdateSettings,
    progress: Progress | None = None,
) -> Update:
    """Return what ``passes``, of one light, teach about ``base``, and whether it pays.

    Outliers are not looked for. Raises ``InvalidInput`` for a field that is no splats, or passes of
    too few vehicles or frames, ``DatasetError`` for a picture that cannot be read.
    """
    if not isinstance(base, SplatField):
        raise InvalidInput("field", f"{base.metadata.kind} cannot be updated, only splats")
    check_passes(passes, settings.min_identities)
    learnt, held_back = split_frames(passes, settings.frames)
    made = _made(base, learnt, settings, progress)
    steps, total = count(1), 2 * len(TRIAL_CRFS) * len(held_back)

    def told() -> None:
        if progress is not None:
            progress("trial", next(steps), total)

    saved = saved_percent(*(try_field(field, held_back, told) for field in (base, made)))
    named = {f"{n + 1} {passes[n].identity}": percent for n, percent in saved.items()}
    update = Update(made, named, len(learnt) + len(held_back))
    return replace(update, refused=_refusal(update, settings))


def _dropped(passes: Sequence[Pass], kept: Sequence[Pass]) -> dict[str, int]:
    dropped: dict[str, int] = {}
    for sign, drives in ((1, passes), (-1, kept)):
        for drive in drives:
            dropped[drive.identity] = dropped.get(drive.identity, 0) + sign * len(drive.pictures)
    return {identity: count for identity, count in dropped.items() if count}


def _made(
    base: SplatField,
    frames: Sequence[SeenFrame],
    settings: UpdateSettings,
    progress: Progress | None,
) -> SplatField:
    """Return what is learnt of ``base``, or of the field that it is itself a delta or layer of."""
    if settings.learn_as is LearnAs.COLOURS:
        return colour_layer(base, frames, settings.colours, progress)
    as_delta, root = settings.learn_as is LearnAs.DELTA, base.base or base
    if as_delta:
        check_base(root)
    made = fine_tuned(base, frames, settings.fine_tuning, progress, keep_order=as_delta)
    made = made.described(replace(made.metadata, training_digest=_digest(base, frames)))
    return delta_of(root, made) if as_delta else made.compressed()


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
