"""``rfedge field info``: what a field archive holds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldInfo"]


@dataclass(frozen=True)
class FieldInfo:
    """Print what is known about a field, and what a frame of each rung takes here."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    size: tuple[int, int] = (1280, 720)
    """Width and height of the frames measured, px (without --drive)."""
    drive: Path | None = None
    """Posed pictures to measure every rung against, in dB and in ms."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Load, describe, measure."""
        from rich.console import Console

        from rfcore.dataset import read_dataset
        from rfcore.field import SplatField
        from rfcore.views import PosedPicture
        from rfedge.fields.describe import describe_field, print_rungs
        from rfedge.fields.find import open_field
        from rfedge.fields.speed import frame_ms
        from rfedge.fields.viewpoints import look_around

        console = Console()
        field = open_field(self.field, threads=self.threads)
        for name, value in describe_field(field):
            console.print(f"{name:>13}  {value}", highlight=False)
        pictures: tuple[PosedPicture, ...] = ()
        cameras = look_around(field, *self.size)
        if self.drive is not None:
            origin = field.metadata.tile_origin
            pictures = read_dataset(self.drive, tile_origin=origin).pictures
            cameras = [picture.camera for picture in pictures]
        if isinstance(field, SplatField):
            print_rungs(console, field, cameras, pictures)
        else:
            console.print(f"{'frame':>13}  {frame_ms(field, cameras, rounds=1):.1f} ms")
