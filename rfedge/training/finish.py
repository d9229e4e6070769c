"""Finish a trained field: choose its size, fit levels of detail, compress it and measure it.

The header of a finished field states the held-out quality of the compressed field.

How large a field should be depends on how often vehicles drive through it. ``FieldSizer`` takes one
of ``SIZES``: either the first that fits into a number of bytes, or the one with the fewest bytes of
field and stream over a number of passes. For the latter it codes the stream as a vehicle does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.camera import Camera
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.importance import (
    contributions,
    frugal_colours,
    most_important_first,
    reordered,
    seen_directions,
)
from rfcore.field.quality import LevelsOfDetail
from rfcore.field.splat_grid import FINEST, Grain, Steps
from rfcore.field.store import encode_field
from rfcore.raster.gaussians import Gaussians
from rfcore.train.levels import LevelFitConfig, SecondsLeft, fitted, with_levels
from rfcore.train.trainer import held_out_quality
from rfcore.update.passes import SeenFrame
from rfcore.update.run import Trial, saved_percent, try_field
from rfcore.views import PosedPicture, spread

MOST_CAMERAS = 60
"""Number of cameras, evenly spread, from which the visible directions of splats are taken."""
TRIAL_FRAMES = 8
"""Consecutive frames that are coded against every size."""
FEWEST_CAMERAS = 12
"""The same in a run that has little time left."""
SEEN_SHARE = 0.3
"""Share of what is left of a run that may be spent on visible directions."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Its multiples, without their whole part, are spread evenly wherever they end."""
TRIED_SPLATS = 16
"""Every so many splats are compressed to see how long it takes."""
LEVELS_SHARE = 1.15
"""Upper bound of what fitted levels multiply a field's bytes by; 1.12 on the first sample."""


@dataclass(frozen=True)
class FieldSize:
    """A size that a field can have: a share of its splats, on coarser grids.

    ``price`` as in ``frugal_colours``; ``steps`` and ``grain`` as in ``compressed_archive``.
    """

    share: float
    price: float
    steps: Steps
    grain: Grain = FINEST


FINE = Steps(opacity_logits=2)
MIDDLE = Steps(opacity_logits=2, sh_dc=4)
COARSE = Steps(opacity_logits=1, sh_dc=4)
SIZES = (
    FieldSize(1.0, 0.003, FINE),
    FieldSize(1.0, 0.01, MIDDLE, Grain(2)),
    FieldSize(1.0, 0.03, COARSE, Grain(2, 2)),
    FieldSize(0.85, 0.03, COARSE, Grain(2, 2)),
    FieldSize(0.7, 0.03, COARSE, Grain(2, 2)),
    FieldSize(0.6, 0.06, COARSE, Grain(2, 2)),
    FieldSize(0.5, 0.06, COARSE, Grain(2, 2)),
    FieldSize(0.4, 0.1, COARSE, Grain(1, 4)),
    FieldSize(0.3, 0.1, COARSE, Grain(1, 4)),
    FieldSize(0.2, 0.1, COARSE, Grain(1, 4)),
)
"""Sizes from the largest to the smallest, each 0.75 to 0.9 of the bytes of the one before. The
first three are measured on the sample field; those with fewer splats are not."""


@dataclass(frozen=True)
class SizeGoal:
    """The largest number of bytes, and the number of passes over which bytes are counted.

    Without either, the largest of ``SIZES`` is taken. Raises ``InvalidInput`` for less than 1.
    """

    max_bytes: int | None = None
    passes: int | None = None

    def __post_init__(self) -> None:
        for name in ("max_bytes", "passes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"size.{name}", f"{value} is below 1")


def size_goal(max_mb: float | None, passes: int | None) -> SizeGoal:
    """Return the goal of ``--max-mb`` and ``--passes``."""
    return SizeGoal(round(max_mb * 1e6) if max_mb is not None else None, passes)


class FieldSizer:
    """Brings a field to the size that a goal asks for.

    ``views`` say from where splats are seen; their pixels are not read. ``drive`` has the pictures
    of a pass in their order; they are coded to choose a size for ``SizeGoal.passes``. With
    ``left_s``, levels leave ``after_s`` seconds of it.
    """

    def __init__(
        self,
        views: Sequence[PosedPicture],
        drive: Sequence[PosedPicture],
        config: LevelFitConfig,
        console: Console,
        left_s: SecondsLeft | None = None,
        after_s: float = 0.0,
    ) -> None:
        self._left_s, self._after_s = left_s, after_s
        self._cameras = [view.camera for view in views]
        self._seen_from = [view.camera for view in spread(views, MOST_CAMERAS)]
        self._drive = drive
        self._config = config
        self._console = console

    def sized(self, field: SplatField, goal: SizeGoal) -> SplatField:
        """Return ``field`` in the size that ``goal`` asks for, with levels fitted, compressed.

        Raises ``InvalidInput`` if the smallest size takes more than ``goal.max_bytes``.
        """
        start = 0 if goal.passes is None else self._cheapest(field, goal.passes)
        for size in SIZES[start:]:
            if size is not SIZES[-1] and not self._may_fit(field, size, goal):
                continue
            written = self._frugal(self._with_levels(self._pruned(field, size)), size)
            if goal.max_bytes is None or _bytes(written) <= goal.max_bytes:
                return written
        raise InvalidInput(
            "max_mb",
            f"{goal.max_bytes} bytes are too few: the smallest size, {SIZES[-1].share:.0%} of the "
            f"splats, has {_bytes(written)}; allow more",
        )

    def _may_fit(self, field: SplatField, size: FieldSize, goal: SizeGoal) -> bool:
        """Return whether a size may be small enough, measured without fitting anything."""
        if goal.max_bytes is None:
            return True
        unfitted = self._frugal(self._pruned(field, size, fit=False), size)
        return LEVELS_SHARE * _bytes(unfitted) <= goal.max_bytes

    def _cheapest(self, field: SplatField, passes: int) -> int:
        """Return the number of the size that takes the fewest bytes over ``passes``.

        Sizes are tried from the largest on, until the sum has risen twice.
        """
        frames = _trial_frames(self._drive)
        first: Trial | None = None
        totals: list[float] = []
        for size in SIZES:
            small = self._frugal(self._pruned(field, size), size)
            trial = try_field(small, frames)
            first = trial if first is None else first
            a_pass = _pass_bytes(first, trial, len(self._drive))
            totals.append(LEVELS_SHARE * _bytes(small) + passes * a_pass)
            self._console.print(
                f"  {small.primitives:,} splats, about {LEVELS_SHARE * _bytes(small) / 1e6:.2f} MB,"
                f" {a_pass / 1e6:.3f} MB a pass: {totals[-1] / 1e6:.2f} MB over {passes} passes"
            )
            if len(totals) > 2 and totals[-1] > totals[-2] > totals[-3]:
                break
        return totals.index(min(totals))

    def _pruned(self, field: SplatField, size: FieldSize, *, fit: bool = True) -> SplatField:
        """Return the splats that contribute most, fitted to the renders of all if ``fit``.

        The field has no levels yet; they are fitted to the splats that are kept.
        """
        keep = math.ceil(size.share * field.primitives)
        if keep == field.primitives:
            return _with_splats(field, field.gaussians, {})
        full, config = field.rasterizer(), self._config
        weights = contributions(
            field.gaussians, self._cameras, threads=config.threads, antialiased=full.antialiased
        )
        kept = reordered(field.gaussians, most_important_first(weights)[:keep])
        return _with_splats(field, fitted(kept, full, self._cameras, config) if fit else kept, {})

    def _with_levels(self, field: SplatField) -> SplatField:
        left_s, after_s = self._left_s, self._after_s
        fit_left_s = None if left_s is None else lambda: left_s() - after_s
        return fit_levels(field, self._cameras, self._config, self._console, fit_left_s)

    def _frugal(self, field: SplatField, size: FieldSize) -> SplatField:
        """Return the compressed field, with colours simplified in directions nobody sees."""
        taken: list[Camera] = []
        seen = seen_directions(
            field.gaussians,
            self._while_time(taken),
            threads=self._config.threads,
            antialiased=field.metadata.antialiased,
        )
        price = size.price * len(taken) / max(len(self._seen_from), 1)
        colours = frugal_colours(field.gaussians, seen, size.steps, price)
        return _with_splats(field, colours, field.levels).compressed(size.steps, size.grain)

    def _while_time(self, taken: list[Camera]) -> Iterator[Camera]:
        """Yield cameras that visible directions are taken from, all over the drive, as long as
        there is time; note them in ``taken``."""
        cameras, left_s = self._seen_from, self._left_s
        until_s = 0.0
        if left_s is not None:
            in_turn = sorted(range(len(cameras)), key=lambda index: index * GOLDEN % 1)
            cameras, until_s = [cameras[index] for index in in_turn], (1 - SEEN_SHARE) * left_s()
        for camera in cameras:
            if left_s is not None and len(taken) >= FEWEST_CAMERAS and left_s() <= until_s:
                return
            taken.append(camera)
            yield camera


def finishing_s(
    field: SplatField,
    views: Sequence[PosedPicture],
    held_out: Sequence[PosedPicture],
    threads: int,
) -> float:
    """Return how long ordering splats, compressing and measuring a field takes at least, from
    doing a part of each."""
    few = reordered(field.gaussians, np.arange(0, field.primitives, TRIED_SPLATS))
    part, config = _with_splats(field, few, {}), LevelFitConfig(threads=threads)
    camera = views[0].camera
    sizer = FieldSizer(views[:1], (), config, Console(quiet=True))
    compressing_s = TRIED_SPLATS * _seconds(lambda: sizer._frugal(part, SIZES[0]))
    antialiased = field.metadata.antialiased
    looking_s = len(views) * _seconds(
        lambda: contributions(field.gaussians, [camera], threads=threads, antialiased=antialiased)
    )
    seeing_s = FEWEST_CAMERAS * _seconds(
        lambda: seen_directions(field.gaussians, [camera], threads=threads)
    )
    measuring_s = 0.0
    if held_out:
        measuring_s = len(held_out) * _seconds(lambda: held_out_quality(field, held_out[:1]))
    return compressing_s + looking_s + seeing_s + measuring_s


def _seconds(work: Callable[[], object]) -> float:
    began_s = monotonic()
    work()
    return monotonic() - began_s


def _with_splats(field: SplatField, gaussians: Gaussians, levels: LevelsOfDetail) -> SplatField:
    """Return the field with other splats and levels, and without its measured quality."""
    metadata = replace(field.metadata, held_out_psnr_db=None, held_out_ssim=None)
    return SplatField(gaussians, metadata, levels=levels, threads=field.threads, isa=field.isa)


def _trial_frames(drive: Sequence[PosedPicture]) -> list[SeenFrame]:
    """Return consecutive frames from the middle of the drive."""
    start = max(0, (len(drive) - TRIAL_FRAMES) // 2)
    part = drive[start : start + TRIAL_FRAMES]
    return [SeenFrame(picture.camera.rounded(), picture.read(), 0) for picture in part]


def _pass_bytes(first: Trial, trial: Trial, frames: int) -> float:
    """Return the bytes of ``frames`` at the quality of ``first``'s middle rate."""
    _, frame_bytes = first.points[0][len(first.points[0]) // 2]
    return frames * frame_bytes * (1 - saved_percent(first, trial)[0] / 100)


def _bytes(field: RadianceField) -> int:
    return len(encode_field(field))


def finish_field(
    field: SplatField,
    views: Sequence[PosedPicture],
    held_out: Sequence[PosedPicture],
    config: LevelFitConfig,
    console: Console,
    goal: SizeGoal | None = None,
    left_s: SecondsLeft | None = None,
) -> SplatField:
    """Return the field with levels fitted to ``views``' cameras, compressed and measured.

    ``goal`` says how large the field may be. With ``left_s`` the fit of levels leaves time to
    compress and to measure. Passes are like ``held_out``, or like ``views`` if that is empty; then
    the header states no quality.
    """
    after_s = 0.0 if left_s is None else finishing_s(field, views, held_out, config.threads)
    sizer = FieldSizer(views, held_out or views, config, console, left_s, after_s)
    small = sizer.sized(field, goal if goal is not None else SizeGoal())
    if not held_out:
        return small
    quality = held_out_quality(small, held_out)
    console.print(f"  as written: {quality.psnr_db:.2f} dB, SSIM {quality.ssim:.3f} held out")
    measured = replace(small.metadata, held_out_psnr_db=quality.psnr_db, held_out_ssim=quality.ssim)
    return small.described(measured)


def fit_levels(
    field: SplatField,
    cameras: list[Camera],
    config: LevelFitConfig,
    console: Console,
    left_s: SecondsLeft | None = None,
) -> SplatField:
    """Return the field with lower levels of detail fitted to ``cameras``, showing progress."""
    columns = (
        TextColumn("levels of detail"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("levels", total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return with_levels(field, cameras, config, show, left_s=left_s)
