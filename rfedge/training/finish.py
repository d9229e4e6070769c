"""From a trained field to the one that is written, and the run as one JSON object.

Written fields have lower levels of detail, are compressed, and state the held-out quality of the
field as it will be read, not as it was trained. The JSON has quality, time, size and how to repeat
the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.camera import Camera
from rfcore.field import RadianceField, SplatField
from rfcore.train import held_out_quality
from rfcore.train.levels import LevelFitConfig, with_levels
from rfcore.views import PosedPicture
from rfedge.results import make_result, provenance
from rfedge.training.refined_poses import PoseRefinement
from rfedge.training.run import Trained, TrainingJob

__all__ = ["finish_field", "fit_levels", "training_result"]


def finish_field(
    field: SplatField,
    views: Sequence[PosedPicture],
    held_out: Sequence[PosedPicture],
    config: LevelFitConfig,
    console: Console,
) -> SplatField:
    """Return the field with levels fitted to ``views``' cameras, compressed and measured.

    ``held_out`` may be empty: then the header states no quality.
    """
    small = fit_levels(field, [view.camera for view in views], config, console).compressed()
    if not held_out:
        return small
    quality = held_out_quality(small, held_out)
    console.print(f"  as written: {quality.psnr_db:.2f} dB, SSIM {quality.ssim:.3f} held out")
    measured = replace(small.metadata, held_out_psnr_db=quality.psnr_db, held_out_ssim=quality.ssim)
    return small.described(measured)


def fit_levels(
    field: SplatField, cameras: list[Camera], config: LevelFitConfig, console: Console
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

        return with_levels(field, cameras, config, show)


def _refinement(refinement: PoseRefinement | None) -> dict[str, float] | None:
    """Return how far poses were moved, for the result."""
    if refinement is None:
        return None
    names = ("median_m", "p95_m", "median_deg", "p95_deg")
    return {name: getattr(refinement, name) for name in names}


def training_result(
    job: TrainingJob, trained: Trained, written: RadianceField, archive: Path
) -> dict[str, Any]:
    """Return the result of a run whose field was written to ``archive``.

    ``held_out`` is the quality of the field as written; the curve ends with that as trained.
    """
    k = job.dataset.pictures[0].camera.intrinsics
    metadata = written.metadata
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
        "pose_refinement": _refinement(trained.refinement),
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
