"""Train a field with a progress bar and measure it on pictures it never saw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rfcore.dataset import Dataset
from rfcore.errors import DatasetError
from rfcore.field import SplatField
from rfcore.train import SplatTrainer, SplatTrainingConfig, held_out_quality

__all__ = ["TrainingJob", "train_field", "training_config"]


@dataclass(frozen=True)
class TrainingJob:
    """What to train on, how, and what to measure on (``held_out`` may be None)."""

    name: str
    dataset: Dataset
    held_out: Dataset | None
    config: SplatTrainingConfig
    seed: int


def training_config(
    gaussians: int | None, iterations: int | None, threads: int
) -> SplatTrainingConfig:
    """Return the trainer's own settings with what the user chose instead."""
    config = SplatTrainingConfig(threads=threads)
    if gaussians is not None:
        config = replace(config, gaussians=gaussians)
    if iterations is not None:
        config = replace(config, iterations=iterations)
    return config


def train_field(job: TrainingJob, console: Console) -> SplatField:
    """Train to the end, showing progress and time left; return the field with its held-out PSNR.

    Raises ``DatasetError`` when the dataset has no points to start from.
    """
    if job.dataset.points is None:
        raise DatasetError("the dataset names no points (ply_file_path) to start Gaussians from")
    console.print(
        f"[bold]Training[/] {job.config.gaussians:,} Gaussians at most on "
        f"{len(job.dataset.pictures)} pictures, {job.config.iterations} iterations"
    )
    trainer = SplatTrainer(job.dataset.pictures, job.dataset.points, job.config, seed=job.seed)
    started_s = monotonic()
    _run_with_bar(trainer, console)
    training_s = monotonic() - started_s
    field = trainer.field(job.name, job.dataset.tile_origin)
    if job.held_out is None:
        console.print(f"  {training_s:.0f} s of training")
        return field
    quality = held_out_quality(field, job.held_out.pictures)
    console.print(f"  {training_s:.0f} s of training, held-out PSNR {quality.psnr_db:.2f} dB")
    return trainer.field(job.name, job.dataset.tile_origin, quality)


def _run_with_bar(trainer: SplatTrainer, console: Console) -> None:
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.4f}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("train", total=trainer.config.iterations, loss=float("nan"))
        for progress in trainer.steps():
            bar.update(task, completed=progress.iteration, loss=progress.loss)
