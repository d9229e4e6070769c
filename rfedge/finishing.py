"""From a trained field to the one that is written: lower rungs, compression, held-out quality.

The quality in the header is that of the field as it will be read, not as it was trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.camera import Camera
from rfcore.field import SplatField
from rfcore.train import held_out_quality
from rfcore.train.rungs import RungConfig, with_rungs
from rfcore.views import PosedPicture

__all__ = ["finish_field", "fit_rungs"]


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
    quality = held_out_quality(small, held_out)
    console.print(f"  as written: {quality.psnr_db:.2f} dB, SSIM {quality.ssim:.3f} held out")
    measured = replace(small.metadata, held_out_psnr_db=quality.psnr_db, held_out_ssim=quality.ssim)
    return small.described(measured)


def fit_rungs(
    field: SplatField, cameras: list[Camera], config: RungConfig, console: Console
) -> SplatField:
    columns = (TextColumn("rungs"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("rungs", total=None)

        def moved(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return with_rungs(field, cameras, config, moved)
