"""``rfedge scene convert``: any dataset into plain pictures with a transforms.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["SceneConvert"]


@dataclass(frozen=True)
class SceneConvert:
    """Write a dataset of any format as undistorted PNG pictures and a transforms.json, once."""

    dataset: Annotated[Path, Positional]
    """A folder with transforms.json, a COLMAP model, a KITTI sequence, INRIA's cameras.json or a
    recording's camera.toml; or that file itself."""
    out: Path
    """The folder to make."""
    size: str | None = None
    """Reduce pictures to WIDTHxHEIGHT px by averaging areas; default: as they are."""
    every: int = 1
    """Take each n-th picture."""
    offset: int = 0
    """Leave out the first pictures, so many."""

    def run(self) -> None:
        """Convert; the folder appears when all of it is there."""
        from rfedge.converting import convert_dataset
        from rfedge.sizes import parse_size

        size_px = parse_size(self.size) if self.size is not None else None
        chosen = slice(self.offset, None, self.every)
        print(convert_dataset(self.dataset, self.out, size_px, chosen))
