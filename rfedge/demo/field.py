"""The field of the demo: the one that ships beside the sample, or one trained anew and kept.

Beside ``samples/street`` lie ``samples/fields/street.rff``, ``street.json``, the record of how the
field was made, and ``manifest.json``, the digests of both; ``make sample-field`` makes them. The
shipped field is used unless the user asks for training, or for settings of their own.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import tyro
from rich.console import Console
from tyro.conf import Positional

from rfcore.dataset import read_dataset, verify_manifest, write_manifest
from rfcore.errors import DatasetError, FieldFormatError, InvalidData
from rfcore.field import SplatField, load_field, save_field
from rfcore.field.store import encode_field
from rfcore.files import write_whole
from rfcore.train import Bands, DensityControl, SplatTrainingConfig
from rfcore.train.levels import LevelFitConfig
from rfedge.program import run_program
from rfedge.results import Provenance, make_result, provenance, write_result
from rfedge.samples import sample_path
from rfedge.training.finish import SizeGoal, finish_field, size_goal
from rfedge.training.run import TrainingJob, train_field, training_config

__all__ = [
    "FieldChoice",
    "MakeSampleField",
    "cache_path",
    "check_sample_field",
    "choose_field",
    "main",
    "sample_field_path",
    "trained_field",
    "write_sample_field",
]


COMMAND = "make sample-field"
MAX_BYTES = 8_000_000
"""More would weigh down every checkout."""


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
        raise DatasetError(f"{path}: has no readable record beside it; run {COMMAND}") from error
    except DatasetError as error:
        raise DatasetError(f"{error}; or run with --train") from error
    if made_from != _manifest_digest(sample):
        raise DatasetError(f"{path}: made from another {sample}; run {COMMAND}, or use --train")


def write_sample_field(sample: Path, field: SplatField, made: Provenance, seconds: int) -> int:
    """Write the field, its record and the manifest; return the field's size in bytes.

    ``made`` and ``seconds`` go into the record: how the field was made, and in what time.

    Raises ``InvalidData`` for one too large to ship, and leaves what was there.
    """
    path, data = sample_field_path(sample), encode_field(field)
    if len(data) > MAX_BYTES:
        raise InvalidData(f"{path}: {len(data)} bytes are over the {MAX_BYTES} a sample may take")
    path.parent.mkdir(exist_ok=True)
    write_whole(path, data)
    record = {**_record(sample, field), "seconds": seconds, "bytes": len(data)}
    write_result(path.with_suffix(".json"), make_result("sample-field", made, record))
    write_manifest(path.parent)
    return len(data)


def _record(sample: Path, field: SplatField) -> dict[str, Any]:
    metadata = field.metadata
    return {
        "field": f"splats {field.field_id}",
        "sample_manifest_sha256": _manifest_digest(sample),
        "training_digest": metadata.training_digest,
        "held_out": {"psnr_db": metadata.held_out_psnr_db, "ssim": metadata.held_out_ssim},
        "primitives": field.primitives,
    }


def _manifest_digest(sample: Path) -> str:
    return hashlib.sha256((sample / "manifest.json").read_bytes()).hexdigest()


@dataclass(frozen=True)
class MakeSampleField:
    """Train a sample's field, fit its levels, compress it, and write it with its record."""

    sample: Annotated[Path, Positional] = sample_path("street")
    """Dataset folder with a manifest: training views, points and the drive `empty`."""
    gaussians: int | None = None
    """At most how many Gaussians to start with; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations; default: the trainer's own."""
    limit: int | None = None
    """Density control: let the set grow to so many Gaussians."""
    antialiased: bool = False
    """Draw splats smaller than a pixel fainter; the field says so."""
    sh_degree: int | None = None
    """Bands of the colour's dependence on direction, 0..3; default: the trainer's own."""
    sky: int = 0
    """In how many directions the sky is looked for."""
    max_mb: float | None = None
    """Write the best field of at most so many MB (10^6 bytes)."""

    def run(self) -> None:
        """Make it; raise ``RfedgeError`` when the sample is damaged or the field too large."""
        verify_manifest(self.sample)
        console, started_s, made = Console(), monotonic(), provenance(command=self._command())
        goal = size_goal(self.max_mb, None)
        field = trained_field(self.sample, self._config(), console, goal)
        seconds = round(monotonic() - started_s)
        size_bytes = write_sample_field(self.sample, field, made, seconds)
        path = sample_field_path(self.sample)
        print(f"{path}: {size_bytes / 1e6:.2f} MB, field {field.field_id}")

    def _config(self) -> SplatTrainingConfig:
        threads = len(os.sched_getaffinity(0))
        config = training_config(self.gaussians, self.iterations, threads)
        config = replace(config, antialiased=self.antialiased, sky=self.sky)
        if self.sh_degree is not None:
            config = replace(config, bands=Bands(degree=self.sh_degree))
        if self.limit is None:
            return config
        return replace(config, density=DensityControl(limit=self.limit))

    def _command(self) -> str:
        names = ("gaussians", "iterations", "limit", "sh_degree", "max_mb")
        given = {name: getattr(self, name) for name in names}
        options = " ".join(
            f"--{n.replace('_', '-')} {v}" for n, v in given.items() if v is not None
        )
        options += f" --sky {self.sky}" if self.sky else ""
        options += " --antialiased" if self.antialiased else ""
        options = options.strip()
        return f'make sample-field ARGS="{options}"' if options else "make sample-field"


def main() -> int:
    """Parse the command line and make the field; return the exit status."""
    return run_program("sample-field", lambda: tyro.cli(MakeSampleField, prog="sample-field"))


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


if __name__ == "__main__":
    sys.exit(main())
