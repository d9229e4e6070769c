"""``rfedge train``: posed pictures in, a radiance field out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["Train"]


@dataclass(frozen=True)
class Train:
    """Train a 3D Gaussian Splatting field from posed pictures and surface points."""

    dataset: Annotated[Path, Positional]
    """A transforms.json (nerfstudio / instant-ngp), or the folder that holds it."""
    out: Path
    """The field archive to write (.rff)."""
    held_out: Path | None = None
    """A transforms.json of pictures to measure on, never trained on."""
    gaussians: int | None = None
    """At most how many Gaussians, drawn from the points at random; default: the trainer's own."""
    iterations: int | None = None
    """Training iterations, one picture each; default: the trainer's own."""
    seed: int = 1
    """Seed of every random choice: the same seed gives the same bytes."""
    threads: int = 2
    """Threads of the rasterizer."""
    name: str = "field"
    """A name kept in the archive's header."""

    def run(self) -> None:
        """Train, write the archive, print its id and quality."""
        from rich.console import Console

        from rfcore.dataset import read_transforms
        from rfcore.errors import InvalidInput
        from rfcore.field import save_field
        from rfcore.train.rungs import RungConfig
        from rfedge.finishing import finish_field
        from rfedge.training import TrainingJob, train_field, training_config

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        console = Console()
        job = TrainingJob(
            name=self.name,
            dataset=read_transforms(self.dataset),
            held_out=read_transforms(self.held_out) if self.held_out else None,
            config=training_config(self.gaussians, self.iterations, self.threads),
            seed=self.seed,
        )
        held_out = job.held_out.pictures if job.held_out else ()
        rungs = RungConfig(threads=self.threads)
        field = train_field(job, console)
        field = finish_field(field, job.dataset.pictures, held_out, rungs, console)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(field, self.out)
        console.print(f"{self.out}: field {field_id}, {len(field.gaussians):,} Gaussians")
