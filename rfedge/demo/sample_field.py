"""The trained field that ships beside a sample, and how it is made: ``make sample-field``.

Beside ``samples/street`` lie ``samples/fields/street.rff``, ``street.json``, the record of what
made it from what, and ``manifest.json``, the digests of both.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rfcore.dataset import verify_manifest, write_manifest
from rfcore.errors import DatasetError, InvalidData
from rfcore.field import SplatField
from rfcore.field.load import encode_field
from rfcore.files import write_whole
from rfedge.provenance import host

__all__ = ["Making", "check_sample_field", "sample_field_path", "write_sample_field"]

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


@dataclass(frozen=True)
class Making:
    """How a field was made: by which command, at which revision, in how long."""

    command: str
    revision: str
    seconds: int


def write_sample_field(sample: Path, field: SplatField, making: Making) -> int:
    """Write the field, its record and the manifest; return the field's size in bytes.

    Raises ``InvalidData`` for one too large to ship, and leaves what was there.
    """
    path, data = sample_field_path(sample), encode_field(field)
    if len(data) > MAX_BYTES:
        raise InvalidData(f"{path}: {len(data)} bytes are over the {MAX_BYTES} a sample may take")
    path.parent.mkdir(exist_ok=True)
    write_whole(path, data)
    record = _record(sample, field, making) | {"bytes": len(data)}
    write_whole(path.with_suffix(".json"), json.dumps(record, indent=1) + "\n")
    write_manifest(path.parent)
    return len(data)


def _record(sample: Path, field: SplatField, making: Making) -> dict[str, Any]:
    metadata = field.metadata
    return {
        "field": f"splats {field.field_id}",
        **asdict(making),
        "host": host(),
        "sample_manifest_sha256": _manifest_digest(sample),
        "training_digest": metadata.training_digest,
        "held_out": {"psnr_db": metadata.held_out_psnr_db, "ssim": metadata.held_out_ssim},
        "primitives": field.primitives,
    }


def _manifest_digest(sample: Path) -> str:
    return hashlib.sha256((sample / "manifest.json").read_bytes()).hexdigest()
