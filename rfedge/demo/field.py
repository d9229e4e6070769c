"""The demo's field: the one that ships with the sample, or one trained anew and kept.

A sample ``samples/street`` may have a field ``samples/fields/street.rff``, with a manifest and a
record of how it was made (``rfedge.demo.sample_field``). It is used unless the user asks for
training or for settings of their own.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

from rich.console import Console

from rfcore.dataset import read_dataset
from rfcore.errors import FieldFormatError
from rfcore.field import SplatField, load_field, save_field
from rfcore.train import SplatTrainingConfig
from rfcore.train.rungs import RungConfig
from rfedge.demo.sample_field import check_sample_field, sample_field_path
from rfedge.finishing import finish_field
from rfedge.training import TrainingJob, train_field

__all__ = ["FieldChoice", "cache_path", "choose_field", "trained_field"]

SEED = 1


@dataclass(frozen=True)
class FieldChoice:
    """Which field a demo uses. ``anew``: train even if there is one already."""

    sample: Path
    cache: Path
    training: SplatTrainingConfig
    anew: bool


def choose_field(choice: FieldChoice, console: Console) -> Path:
    """Return the archive of the demo's field, training it if there is none for these settings.

    Raises ``FieldFormatError`` or ``DatasetError`` when the one there is damaged or made from
    another sample: it says to train anew.
    """
    shipped = sample_field_path(choice.sample)
    if not choice.anew and _is_default(choice.training) and shipped.exists():
        check_sample_field(choice.sample)
        return _announced(shipped, console)
    path = cache_path(choice.sample, choice.cache, choice.training)
    if path.exists() and not choice.anew:
        return _announced(path, console)
    field = trained_field(choice.sample, choice.training, console)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_field(field, path)
    return path


def trained_field(sample: Path, config: SplatTrainingConfig, console: Console) -> SplatField:
    """Train the field of a sample and finish it: rungs, compression, quality on the empty drive."""
    views = read_dataset(sample / "transforms_train.json")
    held_out = read_dataset(sample / "transforms_drive_empty.json")
    job = TrainingJob(name=sample.name, dataset=views, held_out=held_out, config=config, seed=SEED)
    field = train_field(job, console)
    rungs = RungConfig(threads=config.threads)
    return finish_field(field, views.pictures, held_out.pictures, rungs, console)


def cache_path(sample: Path, cache: Path, config: SplatTrainingConfig) -> Path:
    """Return where the field of these files and settings is kept.

    A folder of its own, so that a server pointed at it holds this field and no other.
    """
    key = hashlib.sha256((sample / "manifest.json").read_bytes())
    for name, value in _settings(config):
        key.update(f"{name}={value};".encode())
    return cache / f"{sample.name}-{key.hexdigest()[:12]}" / "field.rff"


def _announced(path: Path, console: Console) -> Path:
    """Return ``path`` after reading all of it."""
    try:
        field = load_field(path)
    except FieldFormatError as error:
        raise FieldFormatError(f"{error}; run again with --train to make it anew") from error
    db = field.metadata.held_out_psnr_db
    quality = f", {db:.2f} dB on the empty drive" if db is not None else ""
    console.print(
        f"[bold]Field[/] {field.field_id[:12]} from {path}{quality} (--train makes it anew)"
    )
    return path


def _is_default(config: SplatTrainingConfig) -> bool:
    return _settings(config) == _settings(SplatTrainingConfig())


def _settings(config: SplatTrainingConfig) -> list[tuple[str, object]]:
    """Return what changes the field: not the threads, nor the instruction set."""
    names = [f.name for f in fields(config) if f.name not in ("threads", "isa")]
    return [(name, getattr(config, name)) for name in names]
