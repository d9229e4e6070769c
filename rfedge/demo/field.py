"""The demo's field: trained once from the sample, then kept."""

from __future__ import annotations

import hashlib
from dataclasses import fields
from pathlib import Path

from rich.console import Console

from rfcore.dataset import read_transforms
from rfcore.errors import FieldFormatError
from rfcore.field import load_field, save_field
from rfcore.train import SplatTrainingConfig
from rfedge.training import TrainingJob, train_field

__all__ = ["cache_path", "cached_or_trained"]

SEED = 1


def cached_or_trained(
    sample: Path, cache: Path, config: SplatTrainingConfig, anew: bool, console: Console
) -> Path:
    """Return the archive of the sample's field, training it if ``cache`` holds none.

    Raises ``FieldFormatError`` when the cached archive is damaged: it says to train anew.
    """
    path = cache_path(sample, cache, config)
    if path.exists() and not anew:
        try:
            field = load_field(path)
        except FieldFormatError as error:
            raise FieldFormatError(f"{error}; run again with --train to make it anew") from error
        console.print(f"[bold]Field[/] {field.field_id[:12]} from {path} (--train makes it anew)")
        return path
    job = TrainingJob(
        name=sample.name,
        dataset=read_transforms(sample / "transforms_train.json"),
        held_out=read_transforms(sample / "transforms_drive_empty.json"),
        config=config,
        seed=SEED,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    save_field(train_field(job, console), path)
    return path


def cache_path(sample: Path, cache: Path, config: SplatTrainingConfig) -> Path:
    """Return where the field of these files and settings is kept.

    A folder of its own, so that a server pointed at it holds this field and no other.
    """
    key = hashlib.sha256((sample / "manifest.json").read_bytes())
    for setting in fields(config):
        if setting.name not in ("threads", "isa"):
            key.update(f"{setting.name}={getattr(config, setting.name)};".encode())
    return cache / f"{sample.name}-{key.hexdigest()[:12]}" / "field.rff"
