"""Poses that a run refined: how far they moved, their file, and held-out quality at aligned poses.

Held-out pictures have wrong poses like the others, and measured at these every field looks bad.
Aligned with the field one by one, as a vehicle does that finds its pose in the field, they show how
good the field is. Since that uses the pictures' own pixels, both figures are reported, and fields
are compared with both aligned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from rfcore.camera import Camera, TileOrigin
from rfcore.field import RadianceField, SplatField
from rfcore.files import write_whole
from rfcore.train import FieldTrainer, HeldOut, SplatTrainer, held_out_quality
from rfcore.train.poses import PoseCorrection, align_pictures
from rfcore.views import PosedPicture

__all__ = ["PoseRefinement", "aligned_quality", "refinement_of", "write_refined_poses"]


@dataclass(frozen=True)
class PoseRefinement:
    """How far the pictures' poses moved, and the refined cameras."""

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
