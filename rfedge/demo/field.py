"""The field of the demo: the one that ships beside the sample, or one trained anew and kept.

Beside ``samples/street`` lie ``samples/fields/street.rff``, ``street.json``, the record of how the
field was made, and ``manifest.json``, the digests of both; ``make sample-field`` makes them. The
shipped field is used unless the user asks for training, or for settings of their own.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields
from pathlib import Path

from rich.console import Console

from rfcore.dataset import read_dataset, verify_manifest
from rfcore.errors import DatasetError, FieldFormatError
from rfcore.field import SplatField, load_field, save_field
from rfcore.train.levels import LevelFitConfig
from rfcore.train.splats import SplatTrainingConfig
from rfedge.training.finish import SizeGoal, finish_field
from rfedge.training.run import TrainingJob, train_field

SEED = 1


def choose_field(
    sample: Path, cache: Path, training: SplatTrainingConfig, console: Console, *, anew: bool
) -> Path:
    """Return the archive of the demo's field, training it if there is none for these settings.

    ``anew``: train even if there is one.
    Raises ``FieldFormatError`` or ``DatasetError`` when the field that is there is damaged or was
    made from another sample; the message says to train anew.
    """
    shipped = sample_field_path(sample)
    if not anew and _is_default(training) and shipped.exists():
        check_sample_field(sample)
        return _announced(shipped, console)
    path = cache_path(sample, cache, training)
    if path.exists() and not anew:
        return _announced(path, console)
    field = trained_field(sample, training, console)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_field(field, path)
    return path


def sample_field_path(sample: Path) -> Path:
    """Return where the field of a sample is, if it has one."""
    return sample.parent / "fields" / f"{sample.name}.rff"


def check_sample_field(sample: Path) -> None:
    """Raise ``DatasetError`` unless the shipped field is whole and was made from this sample."""
    path = sample_field_path(sample)
    try:
        verify_manifest(path.parent)
        record = json.loads(path.with_suffix(".json").read_bytes())
        made_from = record["sample_manifest_sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: has no readable record beside it; use --train") from error
    except DatasetError as error:
        raise DatasetError(f"{error}; or run with --train") from error
    if made_from != manifest_digest(sample):
        raise DatasetError(f"{path}: made from another {sample}; use --train")


def manifest_digest(sample: Path) -> str:
    """Return the SHA-256 of a sample's manifest, which stands for all its files."""
    return hashlib.sha256((sample / "manifest.json").read_bytes()).hexdigest()


def trained_field(
    sample: Path, config: SplatTrainingConfig, console: Console, goal: SizeGoal | None = None
) -> SplatField:
    """Train the field of a sample and finish it: levels, size, compression, held-out quality."""
    views = read_dataset(sample / "transforms_train.json")
    held_out = read_dataset(sample / "transforms_drive_empty.json")
    job = TrainingJob(name=sample.name, dataset=views, held_out=held_out, config=config, seed=SEED)
    field = train_field(job, console)
    levels = LevelFitConfig(threads=config.threads)
    return finish_field(field, views.pictures, held_out.pictures, levels, console, goal)


def cache_path(sample: Path, cache: Path, config: SplatTrainingConfig) -> Path:
    """Return where the field of these files and settings is kept.

    Each field has a folder to itself, so that a server pointed at it holds no other.
    """
    key = hashlib.sha256((sample / "manifest.json").read_bytes())
    for name, value in _settings(config):
        key.update(f"{name}={value};".encode())
    return cache / f"{sample.name}-{key.hexdigest()[:12]}" / "field.rff"


def _announced(path: Path, console: Console) -> Path:
    """Return ``path`` after reading all of it and printing which field it holds."""
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
    """Return the settings that change the field; threads and instruction set do not."""
    names = [f.name for f in fields(config) if f.name not in ("threads", "isa")]
    return [(name, getattr(config, name)) for name in names]
