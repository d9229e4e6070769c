"""``rfedge field export``: a field archive as ``.ply`` for other people's viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldExport"]


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
        from rfcore.field.detail import splats_of_rung
        from rfedge.fields.find import open_splats

        if self.out.suffix != ".ply":
            raise InvalidInput("out", f"{self.out} must end in .ply")
        detail = Quality(self.detail).detail
        field = open_splats(self.field, threads=1)
        splats = splats_of_rung(field.gaussians, field.rungs, detail)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_ply(self.out, splats)
        print(f"{self.out}: {len(splats):,} splats of SH degree {splats.sh_degree}")
