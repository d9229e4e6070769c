"""``make sample-field``: train the field that ships beside the sample street."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional

from rfcore.dataset import verify_manifest, write_manifest
from rfcore.errors import InvalidData
from rfcore.field import SplatField
from rfcore.field.store import encode_field
from rfcore.files import write_whole
from rfcore.program import parse_options, run_program
from rfcore.train.schedule import Bands, DensityControl
from rfcore.train.splats import SplatTrainingConfig
from rfedge.demo.field import manifest_digest, sample_field_path, trained_field
from rfedge.results import Provenance, make_result, provenance, write_result
from rfedge.samples import sample_path
from rfedge.training.finish import size_goal
from rfedge.training.run import training_config

MAX_BYTES = 8_000_000
"""More would weigh down every checkout."""


@dataclass(frozen=True)
class MakeSampleField:
    """Train a sample's field, fit its levels, compress it, and write it with its record."""

    sample: Annotated[Path, Positional] = sample_path("street")
    """Dataset folder with a manifest: training views, points and the drive `empty`."""
    gaussians: int | None = None
    """Largest number of Gaussians to start with; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations; default: the trainer's own."""
    limit: int | None = None
    """Density control: let the set grow to this number of Gaussians."""
    antialiased: bool = False
    """Draw splats smaller than a pixel fainter; the field says so."""
    sh_degree: int | None = None
    """Degree of the spherical harmonics of colours, 0..3; default: the trainer's own."""
    sky: int = 0
    """Number of directions in which the sky is looked for."""
    max_mb: float | None = None
    """Write the best field of at most this size, in MB (10^6 bytes)."""

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
        "sample_manifest_sha256": manifest_digest(sample),
        "training_digest": metadata.training_digest,
        "held_out": {"psnr_db": metadata.held_out_psnr_db, "ssim": metadata.held_out_ssim},
        "primitives": field.primitives,
    }


def main() -> int:
    """Parse the command line and make the field; return the exit status."""
    return run_program("sample-field", lambda: parse_options(MakeSampleField, "sample-field").run())


if __name__ == "__main__":
    sys.exit(main())
