"""Train a field with progress on the console, and measure it on pictures it never saw.

With refined poses held-out pictures have wrong poses like the others, and measured at these every
field looks bad. Aligned with the field one by one, as a vehicle does that finds its pose in the
field, they show how good the field is. Since that uses the pictures' own pixels, both figures are
reported, and fields are compared with both aligned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from rfcore.camera import Camera, TileOrigin
from rfcore.dataset import Dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, SplatField
from rfcore.field.place import FITS_DB
from rfcore.files import write_whole
from rfcore.train.ngp import NgpTrainer, NgpTrainingConfig
from rfcore.train.poses import PoseCorrection, align_pictures
from rfcore.train.splats import SplatTrainer, SplatTrainingConfig
from rfcore.train.start import random_points
from rfcore.train.trainer import (
    FieldTrainer,
    HeldOut,
    held_out_quality,
    mean_colour_db,
    mean_psnr_db,
)
from rfcore.vertical import Z_UP, direction, vertical_of
from rfcore.views import PosedPicture, spread
from rfedge.arguments import time_text
from rfedge.results import make_result, provenance
from rfedge.training.finish import finishing_s
from rfedge.training.loop import LoopLimits, TrainingLoop, run_showing
from rfedge.training.memory import (
    available_bytes,
    check_memory,
    most_gaussians,
    training_bytes,
)


@dataclass(frozen=True)
class PoseRefinement:
    """The refined cameras, and the distances by which their poses moved."""

    median_m: float
    p95_m: float
    median_deg: float
    p95_deg: float
    cameras: tuple[Camera, ...]


def refinement_of(trainer: FieldTrainer) -> PoseRefinement | None:
    """Return the refinement of the poses, or None if they were held fixed."""
    if not isinstance(trainer, SplatTrainer):
        return None
    corrections: Sequence[PoseCorrection] = trainer.pose_corrections()
    if not corrections:
        return None
    moved_m = [correction.moved_m for correction in corrections]
    turned_deg = [correction.turned_deg for correction in corrections]
    return PoseRefinement(
        median_m=float(np.median(moved_m)),
        p95_m=float(np.percentile(moved_m, 95)),
        median_deg=float(np.median(turned_deg)),
        p95_deg=float(np.percentile(turned_deg, 95)),
        cameras=tuple(trainer.cameras()),
    )


def aligned_quality(
    trainer: FieldTrainer, field: RadianceField, pictures: Sequence[PosedPicture], threads: int
) -> HeldOut | None:
    """Return the quality at poses aligned with the field, or None for a hash grid."""
    if not (isinstance(trainer, SplatTrainer) and isinstance(field, SplatField)):
        return None
    aligned = align_pictures(field, pictures, trainer.depth_m, threads)
    return held_out_quality(field, aligned)


def write_refined_poses(
    out: Path, pictures: Sequence[PosedPicture], cameras: Sequence[Camera], origin: TileOrigin
) -> None:
    """Write the refined poses as TUM lines in the dataset's world, each after its picture's name.

    The time of a line is the picture's in seconds, or its number in a dataset without times.
    """
    times_ns = [picture.time_ns for picture in pictures]
    timed = len(times_ns) > 1 and all(a < b for a, b in pairwise(times_ns))
    lines = [f"# {'seconds' if timed else 'number of the picture'} tx ty tz qx qy qz qw"]
    for number, (picture, camera) in enumerate(zip(pictures, cameras, strict=True)):
        time_text = f"{picture.time_ns / 1e9:.9f}" if timed else str(number)
        pose = origin.globalise(camera.world_from_cam)
        w, x, y, z = pose.rotation
        numbers = " ".join(f"{value:.12g}" for value in (*pose.translation_m, x, y, z, w))
        lines += [f"# {picture.name}", f"{time_text} {numbers}"]
    write_whole(out, "\n".join(lines) + "\n")


JUDGED, MEANT = 8, 16
"""Pictures by which a field is judged, and those whose mean colour it has to beat."""
PASSES, RISING_PASSES = 10, 30
"""Iterations for each picture below which a run is short, and below which quality rises fast."""
LEVELS_SHARE = 0.05
"""Share of a run limited by time that fitting levels of detail has at least."""
UNLIMITED_ITERATIONS = 1_000_000
"""Iterations of a run that ends by the clock."""


@dataclass(frozen=True)
class TrainingJob:
    """The pictures to train on and to measure on (``held_out`` may be None), and the settings."""

    name: str
    dataset: Dataset
    held_out: Dataset | None
    config: SplatTrainingConfig | NgpTrainingConfig
    """The class of the settings says which kind of field is trained."""
    seed: int
    limits: LoopLimits = field(default_factory=partial(LoopLimits, measurements=0))
    resume: bool = False
    align_held_out: bool = False
    """Measure held-out pictures at poses aligned with the field, too."""


@dataclass(frozen=True)
class Trained:
    """A trained field, before it is finished, with the run's time and quality."""

    field: RadianceField
    quality: HeldOut | None
    seconds: float
    iterations: int
    primitives: int
    curve: tuple[tuple[float, float], ...]
    """Seconds of training and held-out PSNR in dB."""
    refinement: PoseRefinement | None = None
    aligned: HeldOut | None = None
    """``quality`` at poses of the held-out pictures that were aligned with the field."""
    ends_s: float = math.inf
    """When the minutes of the run are over, on the monotonic clock."""

    def left_s(self) -> float:
        """Return the seconds that are left of the minutes of the run."""
        return self.ends_s - monotonic()


def training_config(
    gaussians: int | None, iterations: int | None, threads: int
) -> SplatTrainingConfig:
    """Return the trainer's default settings with the values that the user chose."""
    config = SplatTrainingConfig(threads=threads)
    if gaussians is not None:
        config = replace(config, gaussians=gaussians)
    if iterations is not None:
        config = replace(config, iterations=iterations)
    return config


def train_field(job: TrainingJob, console: Console) -> SplatField:
    """Train splats as ``train`` does; return the field alone."""
    trained = train(job, console).field
    if not isinstance(trained, SplatField):
        raise InvalidInput("kind", f"{trained.metadata.kind} is not a field of splats")
    return trained


def train(
    job: TrainingJob, console: Console, show: Callable[[FieldTrainer], None] | None = None
) -> Trained:
    """Train to the end, showing progress, held-out PSNR and time left.

    ``show`` is that of ``TrainingLoop``. Raises ``InvalidInput`` if there is too little memory, and
    ``TrainingDiverged`` when the run is lost; the last good checkpoint stays.
    """
    began_s = monotonic()
    _announce(job, console)
    trainer = _trainer(job)
    limits = _leaving_time_to_finish(job, trainer, began_s, console)
    measure = None
    if job.held_out is not None:
        measure = partial(mean_psnr_db, pictures=_in_memory(job.held_out.pictures))
    loop = TrainingLoop(trainer, limits, measure, monotonic, show, monotonic() - began_s)
    if job.resume:
        loop.resume()
        console.print(f"  going on after iteration {trainer.iteration:,}, {loop.seconds:.0f} s")
    run_showing(loop, console, monotonic)
    seconds = loop.seconds
    quality = None if limits.kept_s else _quality(trainer, job)  # else that as written will do
    _announce_end(seconds, quality, console)
    field = trainer.field(job.name, job.dataset.tile_origin, quality, job.dataset.anchor)
    aligned = None
    if job.align_held_out and job.held_out is not None:
        held_out = job.held_out.pictures
        aligned = aligned_quality(trainer, field, held_out, job.config.threads)
    return Trained(
        field=field,
        refinement=refinement_of(trainer),
        aligned=aligned,
        quality=quality,
        seconds=seconds,
        iterations=trainer.iteration,
        primitives=trainer.primitives,
        curve=tuple(loop.curve),
        ends_s=math.inf if loop.left_s is None else monotonic() + loop.left_s,
    )


def _leaving_time_to_finish(
    job: TrainingJob, trainer: FieldTrainer, begun_s: float, console: Console
) -> LoopLimits:
    """Return the limits with as much time kept as finishing is seen to take here and now, at most
    half of what is left."""
    limits, held_out = job.limits, job.held_out
    field = trainer.field() if limits.kept_s and limits.minutes is not None else None
    if limits.minutes is None or not isinstance(field, SplatField):
        return limits
    seen = () if held_out is None else held_out.pictures
    finish_s = finishing_s(field, job.dataset.pictures, seen, job.config.threads)
    most_s = max(60 * limits.minutes - (monotonic() - begun_s), 0) / 2
    kept_s = max(limits.kept_s, min(finish_s + LEVELS_SHARE * 60 * limits.minutes, most_s))
    late_s = finish_s - most_s
    late = f"; it will end about {time_text(late_s)} late" if late_s > 1 else ""
    console.print(
        f"  the last {time_text(kept_s)} are for levels of detail and compression{late}",
        highlight=False,
    )
    return replace(limits, kept_s=kept_s)


def _trainer(job: TrainingJob) -> FieldTrainer:
    pictures, points = job.dataset.pictures, job.dataset.points
    if isinstance(job.config, NgpTrainingConfig):
        return NgpTrainer(pictures, points, job.config, seed=job.seed)
    if points is None:
        rng = np.random.default_rng([job.seed, 2])
        points = random_points(pictures, job.config.gaussians, rng)
    return SplatTrainer(pictures, points, job.config, seed=job.seed)


def needed_bytes(job: TrainingJob) -> int:
    """Return an estimate of the peak memory of a job."""
    return training_bytes(job.config, _sizes_px(job))


def _sizes_px(job: TrainingJob) -> list[tuple[int, int]]:
    cameras = [picture.camera.intrinsics for picture in job.dataset.pictures]
    return [(k.width_px, k.height_px) for k in cameras]


def _announce(job: TrainingJob, console: Console) -> None:
    config, pictures, needed = job.config, job.dataset.pictures, needed_bytes(job)
    if isinstance(config, NgpTrainingConfig):
        what = "a hash grid"
    else:
        what = f"{most_gaussians(config):,} Gaussians at most"
        what += "" if job.dataset.points is not None else ", from random points,"
    length = f"{config.iterations:,} iterations"
    if job.limits.minutes is not None:
        length = f"{job.limits.minutes:g} minutes"
    console.print(
        f"[bold]Training[/] {what} on {len(pictures)} pictures, {length}; about "
        f"{needed / 2**30:.1f} GiB of memory"
    )
    for change in job.dataset.changes:
        console.print(f"  {change}", highlight=False)
    if job.dataset.anchor is None:
        up = vertical_of(picture.camera.world_from_cam for picture in pictures)
        if up is None:
            console.print("  the cameras do not agree which way is up: z is taken")
        elif up != Z_UP:
            console.print(f"  up is {direction(up)}, as the cameras show")
    check_memory(config, _sizes_px(job), available_bytes())
    console.print("  reading the pictures")


def _announce_end(seconds: float, quality: HeldOut | None, console: Console) -> None:
    measured = ""
    if quality is not None:
        measured = f", held-out PSNR {quality.psnr_db:.2f} dB, SSIM {quality.ssim:.3f}"
    console.print(f"  {seconds:.0f} s of training{measured}")


def _quality(trainer: FieldTrainer, job: TrainingJob) -> HeldOut | None:
    if job.held_out is None:
        return None
    return held_out_quality(trainer.field(), job.held_out.pictures)


@dataclass(frozen=True)
class Outcome:
    """A run's result in a line. The run failed if the field is no nearer to pictures than the mean
    colour of those that it was trained on; a few iterations that were asked for are no failure."""

    text: str
    is_failure: bool


def outcome_of(job: TrainingJob, trained: Trained, field: RadianceField) -> Outcome:
    """Judge a finished field by its held-out pictures; without any by some it was trained on."""
    shown = job.dataset.pictures
    seen = spread(shown if job.held_out is None else job.held_out.pictures, JUDGED)
    psnr_db = field.metadata.held_out_psnr_db
    if psnr_db is None:
        psnr_db = mean_psnr_db(field, seen)
    kind = "of training pictures" if job.held_out is None else "held out"
    text = f"{psnr_db:.2f} dB {kind} after {trained.iterations:,} iterations"
    mean_db = mean_colour_db(spread(shown, MEANT), seen)
    few = trained.iterations < PASSES * len(shown)
    more = "--minutes" if job.limits.minutes is not None else "--iterations"
    remedy = "check its poses (rfedge field check), or give points (--points)"
    give_more = f"these are few for {len(shown)} pictures: give more {more}, or a smaller --size"
    if few:
        remedy = give_more
    if psnr_db <= mean_db:
        problem = f"no better than their mean colour ({mean_db:.2f} dB): of no use"
        was_asked_for = few and job.limits.minutes is None
        return Outcome(f"{text}, {problem}; {remedy}", not was_asked_for)
    is_rising = trained.iterations < RISING_PASSES * len(shown)
    if psnr_db < FITS_DB:
        problem = f"below {FITS_DB:g} dB commands take it for a field of another place"
        return Outcome(f"{text}; {problem}; {give_more if is_rising else remedy}", False)
    if is_rising:
        return Outcome(f"{text}; {give_more}", False)
    if job.held_out is None:
        return Outcome(f"{text}; --holdout 8 says how good other views are", False)
    return Outcome(text, False)


def _in_memory(pictures: Sequence[PosedPicture]) -> list[PosedPicture]:
    """Return the pictures already read, since they are measured on many times."""
    if not pictures:
        raise InvalidInput("held_out", "holds no pictures to measure on")
    return [
        replace(
            picture,
            read=partial(_identity, picture.read()),
            mask=None if picture.mask is None else partial(_identity, picture.mask()),
        )
        for picture in pictures
    ]


Values = TypeVar("Values")


def _identity(array: Values) -> Values:
    return array


REFINEMENT = ("median_m", "p95_m", "median_deg", "p95_deg")


def training_result(
    job: TrainingJob, trained: Trained, written: RadianceField, archive: Path
) -> dict[str, Any]:
    """Return the result of a run whose field was written to ``archive``: what it took and gave.

    ``held_out`` is the quality of the field as written; the curve ends with that as trained.
    """
    k = job.dataset.pictures[0].camera.intrinsics
    metadata, refinement = written.metadata, trained.refinement
    content = {
        "field": f"{metadata.kind} {written.field_id}",
        "views": len(job.dataset.pictures),
        "held_out": {
            "psnr_db": metadata.held_out_psnr_db,
            "ssim": metadata.held_out_ssim,
            "views": len(job.held_out.pictures) if job.held_out is not None else 0,
        },
        "as_trained": asdict(trained.quality) if trained.quality is not None else None,
        "held_out_aligned": asdict(trained.aligned) if trained.aligned is not None else None,
        "pose_refinement": {name: getattr(refinement, name) for name in REFINEMENT}
        if refinement is not None
        else None,
        "seconds": trained.seconds,
        "iterations": trained.iterations,
        "primitives": trained.primitives,
        "bytes": archive.stat().st_size,
        "curve": [list(point) for point in trained.curve],
        "width": k.width_px,
        "height": k.height_px,
        "seed": job.seed,
        "settings": asdict(job.config),
        "training_digest": metadata.training_digest,
    }
    return make_result("training", provenance(), content)
