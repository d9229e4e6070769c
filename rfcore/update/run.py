"""One update of a field: learn from passes, try on frames held back, keep it if bits fall.

A trial measures the bits of frames coded against each field, at equal quality. The frames of a pass
are coded in their order at several CRFs, with the references and the light that the encoder
chooses, as on a vehicle. The logarithm of the rate is interpolated over luma PSNR.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import count, groupby

import numpy as np

from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.delta import check_base, delta_of
from rfcore.field.interface import render_field_view
from rfcore.native.yuv import i420_from_rgb
from rfcore.update.colours import ColourFit, colour_layer
from rfcore.update.passes import Pass, SeenFrame, check_passes, split_frames, without_outliers
from rfcore.update.splats import FineTuning, Progress, fine_tuned

TRIAL_CRFS = (22.0, 28.0, 34.0)
HEADER_BYTES = 100
"""Approximate size of a packet with only its pose; without it a saving could be infinite."""
LEAST_ERROR = 0.05
"""Least squared error in levels: a PSNR above 61 dB counts as 61 dB."""
EPOCH = 1
Point = tuple[float, float]
"""Luma PSNR in dB, and bytes a frame."""


@dataclass(frozen=True)
class Trial:
    """Rate and quality of the frames of each pass, by its number, ascending in quality."""

    points: Mapping[int, tuple[Point, ...]]


def try_field(
    field: RadianceField, frames: Sequence[SeenFrame], progress: Callable[[], None] = lambda: None
) -> Trial:
    """Code ``frames`` against ``field``; raise ``InvalidInput`` if there are none.

    ``progress`` is called before each frame is coded, at each CRF.
    """
    if not frames:
        raise InvalidInput("trial", "no frames are held back: give more")
    by_pass = groupby(frames, lambda frame: frame.pass_number)
    return Trial({number: _points(field, list(of_pass), progress) for number, of_pass in by_pass})


def saved_percent(before: Trial, after: Trial) -> dict[int, float]:
    """Return the percentage of bytes that each pass saves; negative if it takes more."""
    return {
        number: 100 * (1 - math.exp(_log_ratio(before.points[number], after.points[number])))
        for number in before.points
    }


def _points(
    field: RadianceField, frames: Sequence[SeenFrame], progress: Callable[[], None]
) -> tuple[Point, ...]:
    views = [render_field_view(field, frame.camera) for frame in frames]
    pictures = [i420_from_rgb(frame.rgb) for frame in frames]
    points = []
    for crf in TRIAL_CRFS:
        encoder = DeltaEncoder(CodecConfig(*pictures[0].size_px, crf=crf))
        state, size_bytes, errors = encoder.start(EPOCH), 0, []
        for picture, view in zip(pictures, views, strict=True):
            progress()
            coded = encoder.encode(state, picture, view)
            state = coded.state
            size_bytes += len(coded.packet.payload) + len(coded.packet.light)
            off = picture.y.astype(np.float64) - coded.reconstruction.y
            errors.append(float((off * off).mean()))
        psnr_db = 10 * math.log10(255.0**2 / max(float(np.mean(errors)), LEAST_ERROR))
        points.append((psnr_db, size_bytes / len(frames) + HEADER_BYTES))
    return tuple(sorted(points))


def _log_ratio(before: Sequence[Point], after: Sequence[Point]) -> float:
    """Return log(after / before) at the middle of the range of quality that both reach."""
    low = max(before[0][0], after[0][0])
    high = min(before[-1][0], after[-1][0])
    quality_db = (low + high) / 2
    return _log_rate(after, quality_db) - _log_rate(before, quality_db)


def _log_rate(points: Sequence[Point], quality_db: float) -> float:
    """Interpolate log(rate) linearly; beyond the points it is constant."""
    qualities_db, rates = zip(*points, strict=True)
    return float(np.interp(quality_db, qualities_db, np.log(rates)))


class LearnAs(StrEnum):
    """The result of an update: another field; another field stored as its difference to the base
    (``rfcore.field.delta``); or a colour layer of one light on the base."""

    ALL = "all"
    DELTA = "delta"
    COLOURS = "colours"


@dataclass(frozen=True)
class UpdateSettings:
    """Settings of an update and of its acceptance."""

    learn_as: LearnAs = LearnAs.ALL
    frames: int = 48
    """Most frames taken from all passes."""
    min_identities: int = 2
    """Fewest vehicles to learn from."""
    min_saved_percent: float = 2.0
    """Least mean saving of bits on the frames held back."""
    max_loss_percent: float = 2.0
    """Most rise of bits for any pass."""
    fine_tuning: FineTuning = field(default_factory=FineTuning)
    colours: ColourFit = field(default_factory=ColourFit)

    def __post_init__(self) -> None:
        if not 8 <= self.frames <= 10_000:
            raise InvalidInput("update.frames", f"{self.frames} is outside 8..10000")
        if self.min_identities < 1:
            raise InvalidInput("update.min_identities", f"{self.min_identities} is below 1")


@dataclass(frozen=True)
class Update:
    """The learnt field, and the percentage of bits that it saves for each pass."""

    learnt: SplatField
    saved_percent: dict[str, float]
    frames: int
    refused: str = ""
    """The reason why it is not to be kept; empty if it is."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames of each vehicle that were left out as outliers."""

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
    """Update ``base`` by ``passes`` of one light, without their outliers.

    Raises as ``learn_from``; if too few frames are left, the error says how many were dropped.
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
    """Update ``base`` by ``passes`` of one light, and test whether it saves bits.

    Outliers are not removed. Raises ``InvalidInput`` for a field that is not of splats, or passes
    of too few vehicles or frames, ``DatasetError`` for a picture that cannot be read.
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
    """Return the field learnt from ``base``; a delta is made on the base of ``base``, if it has
    one."""
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
