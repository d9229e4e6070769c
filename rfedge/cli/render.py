"""``rfedge render``: look at a field along a drive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["Render"]


@dataclass(frozen=True)
class Render:
    """Render a field at every pose of a drive, as PNG files."""

    field: Annotated[Path, Positional]
    """The field archive (.rff)."""
    drive: Path
    """A transforms.json with the poses; its pictures are used only to print PSNR."""
    out: Path
    """Folder for the PNG files."""
    psnr: bool = False
    """Print the PSNR of each render against the drive's picture, dB."""
    threads: int = 2
    """Threads of the rasterizer."""
    isa: str | None = None
    """Force an instruction set: avx512, avx2, neon or scalar."""

    def run(self) -> None:
        """Render the drive."""
        import numpy as np

        from rfcore.dataset import read_dataset
        from rfcore.field import load_field
        from rfcore.image import write_png
        from rfcore.metrics import psnr

        field = load_field(self.field, threads=self.threads, isa=self.isa)
        self.out.mkdir(parents=True, exist_ok=True)
        drive = read_dataset(self.drive, tile_origin=field.metadata.tile_origin)
        for picture in drive.pictures:
            colour = field.render_colour(picture.camera)
            rgb = np.floor(np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8)
            path = self.out / f"{Path(picture.name).stem}.png"
            write_png(path, rgb)
            note = f"  {psnr(rgb, picture.read()):.2f} dB" if self.psnr else ""
            print(f"{path}{note}")
