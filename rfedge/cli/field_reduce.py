"""``rfedge field slim``: fewer splats, without training pictures.

``rfedge field rungs``: give a field lower levels of detail that fill their gaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldRungs", "FieldSlim"]


@dataclass(frozen=True)
class FieldSlim:
    """Keep the splats that matter most, and let them fill the gaps."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    keep: int
    """How many splats to keep."""
    out: Path
    """The archive to write (.rff)."""
    drive: Path | None = None
    """Posed pictures whose cameras the field is to serve; their pixels are not read. Without this,
    opacity and area decide what matters."""
    iterations: int = 240
    """Iterations of fitting the survivors to the full field's renders (with --drive)."""
    raw: bool = False
    """Write float32 instead of the compressed form."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Slim and write."""
        from rfcore.dataset import read_dataset
        from rfcore.errors import InvalidInput
        from rfcore.field import save_field
        from rfcore.train.levels import LevelFitConfig
        from rfedge.fields.describe import size_mb
        from rfedge.fields.find import open_splats
        from rfedge.fields.slim import slimmed

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        field = open_splats(self.field, threads=self.threads)
        cameras = []
        if self.drive is not None:
            dataset = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
            cameras = [picture.camera for picture in dataset.pictures]
        config = LevelFitConfig(iterations=self.iterations, threads=self.threads)
        small = slimmed(field, self.keep, cameras, config)
        small = small if self.raw else small.compressed()
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(small, self.out)
        print(
            f"{self.out}: field {field_id}, {small.primitives:,} of {field.primitives:,} splats, "
            f"{size_mb(small):.2f} MB"
        )


@dataclass(frozen=True)
class FieldRungs:
    """Order a field's splats by what cameras see of them, and fit 50, 25 and 10 % to the whole."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    drive: Path
    """Posed pictures whose cameras the field is to serve; their pixels are not read."""
    out: Path
    """The archive to write (.rff)."""
    iterations: int = 240
    """Iterations of fitting, per level."""
    raw: bool = False
    """Write float32 instead of the compressed form."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Fit and write."""
        from rich.console import Console

        from rfcore.dataset import read_dataset
        from rfcore.errors import InvalidInput
        from rfcore.field import save_field
        from rfcore.train.levels import LevelFitConfig
        from rfedge.fields.describe import size_mb
        from rfedge.fields.find import open_splats
        from rfedge.training.finish import fit_levels

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        field = open_splats(self.field, threads=self.threads)
        dataset = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
        cameras = [picture.camera for picture in dataset.pictures]
        config = LevelFitConfig(iterations=self.iterations, threads=self.threads)
        console = Console()
        refined = fit_levels(field, cameras, config, console)
        refined = refined if self.raw else refined.compressed()
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(refined, self.out)
        print(f"{self.out}: field {field_id}, {size_mb(refined):.2f} MB")
