"""The trained field that ships beside a sample, and how it is made: ``make sample-field``.

Beside ``samples/street`` lie ``samples/fields/street.rff``, ``street.json``, the record of what
made it from what, and ``manifest.json``, the digests of both.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from rfcore.dataset import verify_manifest, write_manifest
from rfcore.errors import DatasetError, InvalidData
from rfcore.field import SplatField, save_field
from rfcore.files import write_whole
from rfedge.provenance import host

__all__ = ["check_sample_field", "sample_field_path", "write_sample_field"]

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


def write_sample_field(sample: Path, field: SplatField, seconds: int, made_by: str) -> int:
    """Write the field, its record and the manifest; return the field's size in bytes.

    ``made_by`` is the revision that trained it.
    """
    path = sample_field_path(sample)
    path.parent.mkdir(exist_ok=True)
    save_field(field, path)
    size_bytes = path.stat().st_size
    if size_bytes > MAX_BYTES:
        path.unlink()
        raise InvalidData(f"{path}: {size_bytes} bytes are over the {MAX_BYTES} a sample may take")
    record = _record(sample, field, seconds, made_by)
    write_whole(path.with_suffix(".json"), json.dumps(record, indent=1) + "\n")
    write_manifest(path.parent)
    return size_bytes


def _record(sample: Path, field: SplatField, seconds: int, made_by: str) -> dict[str, Any]:
    metadata = field.metadata
    return {
        "field": f"splats {field.field_id}",
        "command": COMMAND,
        "revision": made_by,
        "host": host(),
        "sample_manifest_sha256": _manifest_digest(sample),
        "training_digest": metadata.training_digest,
        "held_out": {"psnr_db": metadata.held_out_psnr_db, "ssim": metadata.held_out_ssim},
        "seconds": seconds,
        "primitives": field.primitives,
        "bytes": sample_field_path(sample).stat().st_size,
    }


def _manifest_digest(sample: Path) -> str:
    return hashlib.sha256((sample / "manifest.json").read_bytes()).hexdigest()
