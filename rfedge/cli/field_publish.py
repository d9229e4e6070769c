"""``rfedge field publish``: the next version of a tile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

__all__ = ["FieldPublish"]


@dataclass(frozen=True)
class FieldPublish:
    """Publish a field as the next version of a tile; running servers take it up."""

    field: Annotated[Path, Positional]
    """The archive (.rff)."""
    folder: Path
    """The server's folder of fields (mec-server --fields)."""
    tile: str = "street"
    """The tile whose field it is."""
    area: tuple[float, float, float, float] | None = None
    """West, south, east, north side of the ground it is for, m; as before, at first everywhere."""
    margin_m: float | None = None
    """How far beyond its ground the field serves where a neighbour does not; at first 0."""

    def run(self) -> None:
        """Publish, and say what is current."""
        from datetime import UTC, datetime

        from rfcore.wire.tiles import Area
        from rfedge.fields.publish import Ground, publish

        area = None
        if self.area is not None:
            west_m, south_m, east_m, north_m = self.area
            area = Area((west_m, south_m), (east_m, north_m))
        ground = Ground(area, self.margin_m)
        tile = publish(self.folder, self.tile, self.field, ground, datetime.now(UTC))
        print(f"{tile.name} is version {tile.version}, field {tile.field_id}")
