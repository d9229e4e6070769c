"""``rfedge decode``: a coded drive back into pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["Decode"]


@dataclass(frozen=True)
class Decode:
    """Reconstruct a coded drive as PNG files, with the field it was coded against."""

    coded: Annotated[Path, Positional]
    """The coded drive (.rfv)."""
    field: Path
    """The field archive (.rff)."""
    out: Path
    """Folder for the PNG files."""
    threads: int = 2
    """Threads of the rasterizer."""

    def run(self) -> None:
        """Decode every frame; stop at the first packet that fails a check."""
        from rfcore.field import load_field
        from rfcore.image import write_png
        from rfcore.native.yuv import rgb_from_i420
        from rfcore.wire.drive_file import read_drive
        from rfedge.offline import decode_drive

        drive = read_drive(self.coded)
        field = load_field(self.field, threads=self.threads)
        self.out.mkdir(parents=True, exist_ok=True)
        for decoded in decode_drive(drive, field):
            write_png(self.out / f"{decoded.sequence:06d}.png", rgb_from_i420(decoded.frame))
        print(f"{self.out}: {len(drive.frames)} frames")
