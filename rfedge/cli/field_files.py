"""``rfedge field import``: a ``.ply`` of somebody else's trainer becomes a field archive.

``rfedge field export``: a field archive as ``.ply`` for other people's viewers.

``rfedge field info``: what a field archive holds.

``rfedge field check``: does a field fit a drive, and if not, which convention would make it?
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldCheck", "FieldExport", "FieldImport", "FieldInfo"]


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
        from rfcore.field.similarity import moved, read_field_from_world
        from rfedge.fields.describe import print_levels, size_mb
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
        print_levels(console, field, look_around(field, 1280, 720))


@dataclass(frozen=True)
class FieldExport:
    """Write a field's splats in the property order of the reference implementation."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    out: Path
    """The .ply to write; positions are relative to the tile's origin."""
    detail: float = 1.0
    """Share of the splats: 1, 0.5, 0.25 or 0.1."""

    def run(self) -> None:
        """Load and export."""
        from rfcore.errors import InvalidInput
        from rfcore.field import Quality, write_ply
        from rfcore.field.quality import splats_at_detail
        from rfedge.fields.find import open_splats

        if self.out.suffix != ".ply":
            raise InvalidInput("out", f"{self.out} must end in .ply")
        detail = Quality(self.detail).detail
        field = open_splats(self.field, threads=1)
        splats = splats_at_detail(field.gaussians, field.levels, detail)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_ply(self.out, splats)
        print(f"{self.out}: {len(splats):,} splats of SH degree {splats.sh_degree}")


@dataclass(frozen=True)
class FieldInfo:
    """Print what is known about a field, and what a frame of each level of detail takes here."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    size: tuple[int, int] = (1280, 720)
    """Width and height of the frames measured, px (without --drive)."""
    drive: Path | None = None
    """Posed pictures to measure every level of detail against, in dB and in ms."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Load, describe, measure."""
        from rich.console import Console

        from rfcore.dataset import read_dataset
        from rfcore.field import SplatField
        from rfcore.views import PosedPicture
        from rfedge.fields.describe import describe_field, frame_ms, print_levels
        from rfedge.fields.find import open_field
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
            print_levels(console, field, cameras, pictures)
        else:
            console.print(f"{'frame':>13}  {frame_ms(field, cameras, rounds=1):.1f} ms")


@dataclass(frozen=True)
class FieldCheck:
    """Show four camera pictures beside the field's renders, and say which convention fits."""

    field: Annotated[Path, Positional]
    """The archive (.rff), or the name it was imported under."""
    drive: Path
    """The drive: any dataset of posed pictures."""
    transform: Path | None = None
    """nerfstudio's dataparser_transforms.json, if the field was trained there."""
    out: Path = Path("out/field-check.png")
    """The four pairs, as PNG."""
    fix: Path | None = None
    """Where to write the field in the drive's frame, if another convention fits."""
    threads: int = 2
    """Threads of the renderer."""

    def run(self) -> None:
        """Check; a field that does not fit is an error."""
        from rfcore.dataset import read_dataset
        from rfcore.errors import InvalidData
        from rfcore.field import save_field
        from rfcore.field.similarity import read_field_from_world
        from rfcore.image import write_png
        from rfedge.fields.check import check_field, in_drive_world, pairs_picture
        from rfedge.fields.find import open_field

        field = open_field(self.field, threads=self.threads)
        nerfstudio = read_field_from_world(self.transform) if self.transform else None
        pictures = read_dataset(self.drive, tile_origin=field.metadata.tile_origin).pictures
        fit = check_field(field, pictures, nerfstudio)
        pairs, values_db = pairs_picture(field, pictures, fit.convention)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_png(self.out, pairs)
        shown = ", ".join(f"{value:.2f}" for value in values_db)
        print(f"{self.out}: camera | render, {shown} dB under: {fit.convention.name}")
        if not fit.fits:
            raise InvalidData(
                f"none of {fit.tried} conventions fits: {fit.as_given_db:.2f} dB as it is, at best "
                f"{fit.psnr_db:.2f} dB. Is it the same place? A field trained in nerfstudio needs "
                "--transform dataparser_transforms.json"
            )
        print(
            f"fits {fit.convention.name}: {fit.psnr_db:.2f} dB"
            + (f" instead of {fit.as_given_db:.2f} dB" if fit.tried > 1 else "")
        )
        if self.fix is not None:
            fixed = in_drive_world(field, fit.convention)
            print(f"{self.fix}: field {save_field(fixed, self.fix)}")
