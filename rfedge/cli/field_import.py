"""``rfedge field import``: a ``.ply`` of somebody else's trainer becomes a field archive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldImport"]


@dataclass(frozen=True)
class FieldImport:
    """Read a .ply of INRIA, gsplat, nerfstudio, OpenSplat, Brush or SuperSplat."""

    ply: Annotated[Path, Positional]
    """The file; properties are found by name, text and binary alike."""
    name: str
    """What to call the field."""
    out: Path | None = None
    """The archive to write (default: out/fields/NAME.rff)."""
    transform: Path | None = None
    """nerfstudio's dataparser_transforms.json, to bring the field back to its world."""
    tile_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """East, north and up of the tile, m, taken off in float64."""
    antialiased: bool = False
    """The field was trained with antialiased rasterization (gsplat, Mip-Splatting)."""
    raw: bool = False
    """Keep every float32 as it is instead of compressing to about a tenth."""
    threads: int = 2
    """Threads of the renderer that predicts the time of a frame."""

    def run(self) -> None:
        """Import, print what it is, and how long a frame of it takes here."""
        from rich.console import Console

        from rfcore.camera import TileOrigin
        from rfcore.errors import InvalidInput
        from rfcore.field import FieldMetadata, SplatField, read_ply, save_field
        from rfcore.field.importance import most_important_first, reordered, visible_area
        from rfcore.field.nerfstudio import read_field_from_world
        from rfcore.field.similarity import moved
        from rfedge.fields.describe import print_rungs, size_mb
        from rfedge.fields.find import FOLDER
        from rfedge.fields.viewpoints import look_around

        out = self.out if self.out is not None else FOLDER / f"{self.name}.rff"
        if out.suffix != ".rff":
            raise InvalidInput("out", f"{out} must end in .rff")
        origin = TileOrigin(*self.tile_origin)
        back = read_field_from_world(self.transform).inverse() if self.transform else None
        splats = read_ply(self.ply, origin if back is None else None)
        if not len(splats):
            raise InvalidInput("ply", f"{self.ply} holds no splats")
        if back is not None:
            splats = moved(splats, back.localised(origin))
        splats = reordered(splats, most_important_first(visible_area(splats)))
        metadata = FieldMetadata(self.name, origin, antialiased=self.antialiased)
        field = SplatField(splats, metadata, threads=self.threads)
        field = field if self.raw else field.compressed()
        out.parent.mkdir(parents=True, exist_ok=True)
        field_id = save_field(field, out)
        console = Console()
        print(f"{out}: field {field_id}, {field.primitives:,} splats, {size_mb(field):.2f} MB")
        print_rungs(console, field, look_around(field, 1280, 720))
