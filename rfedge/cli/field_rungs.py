"""``rfedge field rungs``: give a field lower rungs that fill their gaps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldRungs"]


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
    """Iterations of fitting, per rung."""
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
        from rfcore.train.rungs import RungConfig
        from rfedge.fields.describe import size_mb
        from rfedge.fields.find import open_splats
        from rfedge.finishing import fit_rungs

        if self.out.suffix != ".rff":
            raise InvalidInput("out", f"{self.out} must end in .rff")
        field = open_splats(self.field, threads=self.threads)
        dataset = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
        cameras = [picture.camera for picture in dataset.pictures]
        config = RungConfig(iterations=self.iterations, threads=self.threads)
        console = Console()
        refined = fit_rungs(field, cameras, config, console)
        refined = refined if self.raw else refined.compressed()
        self.out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(refined, self.out)
        print(f"{self.out}: field {field_id}, {size_mb(refined):.2f} MB")
