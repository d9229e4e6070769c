"""From a trained field to the one that is written: lower rungs, compression, held-out quality.

The quality in the header is that of the field as it will be read, not as it was trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.camera import Camera
from rfcore.field import RadianceField, SplatField
from rfcore.metrics import psnr, ssim
from rfcore.train.rungs import RungConfig, with_rungs
from rfcore.views import PosedPicture

__all__ = ["finish_field", "fit_rungs", "held_out_quality"]


def finish_field(
    field: SplatField,
    views: Sequence[PosedPicture],
    held_out: Sequence[PosedPicture],
    config: RungConfig,
    console: Console,
) -> SplatField:
    """Return the field with rungs fitted to ``views``' cameras, compressed and measured.

    ``held_out`` may be empty: then the header states no quality.
    """
    small = fit_rungs(field, [view.camera for view in views], config, console).compressed()
    if not held_out:
        return small
    psnr_db, similarity = held_out_quality(small, held_out)
    console.print(f"  as written: {psnr_db:.2f} dB, SSIM {similarity:.3f} on the held-out pictures")
    measured = replace(small.metadata, held_out_psnr_db=psnr_db, held_out_ssim=similarity)
    return small.described(measured)


def held_out_quality(field: RadianceField, pictures: Sequence[PosedPicture]) -> tuple[float, float]:
    """Return the mean over ``pictures`` of PSNR in dB and of SSIM, RGB clipped to 0..1."""
    pairs = [
        (np.clip(field.render_colour(p.camera).astype(np.float64), 0, 1), p.read() / 255.0)
        for p in pictures
    ]
    return (
        float(np.mean([psnr(render, picture, peak=1.0) for render, picture in pairs])),
        float(np.mean([ssim(render, picture, peak=1.0) for render, picture in pairs])),
    )


def fit_rungs(
    field: SplatField, cameras: list[Camera], config: RungConfig, console: Console
) -> SplatField:
    columns = (TextColumn("rungs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("rungs", total=None)

        def moved(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return with_rungs(field, cameras, config, moved)
