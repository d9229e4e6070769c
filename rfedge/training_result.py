"""One training run as one JSON object: quality, time, size, and how to repeat it."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rfcore.field import RadianceField
from rfedge.provenance import host, revision
from rfedge.training import Trained, TrainingJob

__all__ = ["training_result"]


def training_result(
    job: TrainingJob, trained: Trained, written: RadianceField, archive: Path
) -> dict[str, Any]:
    """Return the result of a run whose field was written to ``archive``.

    ``held_out`` is the quality of the field as written; the curve ends with that as trained.
    """
    k = job.dataset.pictures[0].camera.intrinsics
    metadata = written.metadata
    return {
        "field": f"{metadata.kind} {written.field_id}",
        "views": len(job.dataset.pictures),
        "held_out": {
            "psnr_db": metadata.held_out_psnr_db,
            "ssim": metadata.held_out_ssim,
            "views": len(job.held_out.pictures) if job.held_out is not None else 0,
        },
        "as_trained": asdict(trained.quality) if trained.quality is not None else None,
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
        "command": " ".join(["rfedge", *sys.argv[1:]]),
        "revision": revision(),
        "host": host(),
    }
