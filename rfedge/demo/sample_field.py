"""The trained field that ships beside a sample, and how it is made: ``make sample-field``.

Beside ``samples/street`` lie ``samples/fields/street.rff``, ``street.json``, the record of what
made it from what, and ``manifest.json``, the digests of both.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from rfcore.dataset import verify_manifest, write_manifest
from rfcore.errors import DatasetError, InvalidData, RfedgeError
from rfcore.field import SplatField, save_field
from rfcore.files import write_whole
from rfcore.train import SplatTrainingConfig
from rfedge.provenance import host, revision

__all__ = ["check_sample_field", "main", "sample_field_path", "write_sample_field"]

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


def main() -> int:
    """Train the field of the sample named on the command line, and put it beside the sample."""
    from rfedge.demo.field import trained_field

    sample, console = Path(sys.argv[1] if len(sys.argv) > 1 else "samples/street"), Console()
    try:
        verify_manifest(sample)
        started_s = monotonic()
        config = SplatTrainingConfig(threads=len(os.sched_getaffinity(0)))
        field = trained_field(sample, config, console)
        size_bytes = write_sample_field(sample, field, round(monotonic() - started_s))
    except (RfedgeError, OSError) as error:
        print(f"sample-field: {error}", file=sys.stderr)
        return 2
    console.print(f"{sample_field_path(sample)}: {size_bytes / 1e6:.2f} MB, field {field.field_id}")
    return 0


def write_sample_field(sample: Path, field: SplatField, seconds: int) -> int:
    """Write the field, its record and the manifest; return the field's size in bytes."""
    path = sample_field_path(sample)
    path.parent.mkdir(exist_ok=True)
    save_field(field, path)
    size_bytes = path.stat().st_size
    if size_bytes > MAX_BYTES:
        path.unlink()
        raise InvalidData(f"{path}: {size_bytes} bytes are over the {MAX_BYTES} a sample may take")
    record = _record(sample, field, size_bytes, seconds)
    write_whole(path.with_suffix(".json"), json.dumps(record, indent=1) + "\n")
    write_manifest(path.parent)
    return size_bytes


def _record(sample: Path, field: SplatField, size_bytes: int, seconds: int) -> dict[str, Any]:
    metadata = field.metadata
    return {
        "field": f"splats {field.field_id}",
        "command": COMMAND,
        "revision": revision(),
        "host": host(),
        "sample_manifest_sha256": _manifest_digest(sample),
        "training_digest": metadata.training_digest,
        "held_out": {"psnr_db": metadata.held_out_psnr_db, "ssim": metadata.held_out_ssim},
        "seconds": seconds,
        "primitives": field.primitives,
        "bytes": size_bytes,
    }


def _manifest_digest(sample: Path) -> str:
    return hashlib.sha256((sample / "manifest.json").read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
