"""``make sample-field``: train the field of a sample and put it beside the sample."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from time import monotonic

from rich.console import Console

from rfcore.dataset import verify_manifest
from rfcore.errors import RfedgeError
from rfcore.train import SplatTrainingConfig
from rfedge.demo.field import trained_field
from rfedge.demo.sample_field import sample_field_path, write_sample_field
from rfedge.provenance import revision

__all__ = ["main"]


def main() -> int:
    """Train the field of the sample named on the command line, and put it beside the sample."""
    sample, console = Path(sys.argv[1] if len(sys.argv) > 1 else "samples/street"), Console()
    try:
        verify_manifest(sample)
        started_s, made_by = monotonic(), revision()
        config = SplatTrainingConfig(threads=len(os.sched_getaffinity(0)))
        field = trained_field(sample, config, console)
        size_bytes = write_sample_field(sample, field, round(monotonic() - started_s), made_by)
    except (RfedgeError, OSError) as error:
        print(f"sample-field: {error}", file=sys.stderr)
        return 2
    console.print(f"{sample_field_path(sample)}: {size_bytes / 1e6:.2f} MB, field {field.field_id}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
