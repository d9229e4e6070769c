"""``rfedge scene sheet``: built scenes on one page, to be looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["SceneSheet"]


@dataclass(frozen=True)
class SceneSheet:
    """Write a contact sheet of built scenes; docs/scenes-contact-sheet.jpg is made with it."""

    scenes: Annotated[tuple[Path, ...], Positional]
    """Folders that `rfedge scene build` made."""
    out: Path
    """The picture to write (.jpg)."""
    columns: int = 4
    """Pictures of each scene, evenly chosen among those that there are."""
    width_px: int = 1280
    """Width of the sheet, px."""
    max_bytes: int = 600_000
    """The JPEG's quality is lowered until it fits."""

    def run(self) -> None:
        """Write the sheet; say how large it became."""
        from rfedge.street.contact_sheet import write_contact_sheet

        size = write_contact_sheet(
            self.scenes, self.out, self.columns, self.width_px, self.max_bytes
        )
        print(f"{self.out}: {len(self.scenes)} scenes, {size / 1000:.0f} kB")
