"""``make sample-field``: train the field of a sample and put it beside the sample."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional

from rfcore.dataset import verify_manifest
from rfcore.train import DensityControl, SplatTrainingConfig
from rfedge.demo.field import trained_field
from rfedge.demo.maker import run_maker
from rfedge.demo.sample_field import Making, sample_field_path, write_sample_field
from rfedge.provenance import revision
from rfedge.training import training_config

__all__ = ["MakeSampleField", "main"]


@dataclass(frozen=True)
class MakeSampleField:
    """Train a sample's field, fit its rungs, compress it, and write it with its record."""

    sample: Annotated[Path, Positional] = Path("samples/street")
    """Dataset folder with a manifest: training views, points and the drive `empty`."""
    gaussians: int | None = None
    """At most how many Gaussians to start with; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations; default: the trainer's own."""
    limit: int | None = None
    """Density control: let the set grow to so many Gaussians."""
    antialiased: bool = False
    """Draw splats smaller than a pixel fainter; the field says so."""

    def run(self) -> None:
        """Make it; raise ``RfedgeError`` when the sample is damaged or the field too large."""
        verify_manifest(self.sample)
        console, started_s, made_by = Console(), monotonic(), revision()
        field = trained_field(self.sample, self._config(), console)
        making = Making(self._command(), made_by, round(monotonic() - started_s))
        size_bytes = write_sample_field(self.sample, field, making)
        path = sample_field_path(self.sample)
        print(f"{path}: {size_bytes / 1e6:.2f} MB, field {field.field_id}")

    def _config(self) -> SplatTrainingConfig:
        threads = len(os.sched_getaffinity(0))
        config = training_config(self.gaussians, self.iterations, threads)
        config = replace(config, antialiased=self.antialiased)
        if self.limit is None:
            return config
        return replace(config, density=DensityControl(limit=self.limit))

    def _command(self) -> str:
        given = {n: getattr(self, n) for n in ("gaussians", "iterations", "limit")}
        options = " ".join(f"--{n} {v}" for n, v in given.items() if v is not None)
        options += " --antialiased" if self.antialiased else ""
        options = options.strip()
        return f'make sample-field ARGS="{options}"' if options else "make sample-field"


def main() -> int:
    """Parse the command line and make the field; return the exit status."""
    return run_maker(MakeSampleField, "sample-field")


if __name__ == "__main__":
    sys.exit(main())
