"""``rfedge field check``: does a field fit a drive, and if not, which convention would make it?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldCheck"]


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
        from rfcore.field.nerfstudio import read_field_from_world
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
