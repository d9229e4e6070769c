"""``rfedge field list``: the tiles of a folder and their versions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldList"]


@dataclass(frozen=True)
class FieldList:
    """List the tiles that a folder publishes, with all their versions."""

    folder: Annotated[Path, Positional]
    """The server's folder of fields (mec-server --fields)."""

    def run(self) -> None:
        """Print a line a version; the current one has a star."""
        from mec_server.fields_manifest import read_publication

        publication = read_publication(self.folder)
        if not publication.tiles:
            print(f"{self.folder} publishes no tiles")
        for name, tile in sorted(publication.tiles.items()):
            ground = "everywhere"
            if tile.area is not None:
                low, high = tile.area.low_m, tile.area.high_m
                ground = f"{low[0]:g}, {low[1]:g} to {high[0]:g}, {high[1]:g} m"
            print(f"{name}: {ground}, margin {tile.margin_m:g} m")
            for number, field_id in enumerate(tile.field_ids, 1):
                mark = "*" if number == tile.current else " "
                print(f"{mark} {number:3}  {tile.times[number - 1]}  {field_id}")
