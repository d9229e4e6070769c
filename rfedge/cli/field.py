"""``rfedge field``: fields as files. One module a sub-verb.

``rfedge field publish``: the next version of a tile.

``rfedge field list``: the tiles of a folder and their versions.

``rfedge field rollback``: an earlier version of a tile again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, subcommand

from rfedge.cli.field_files import FieldCheck, FieldExport, FieldImport, FieldInfo
from rfedge.cli.field_reduce import FieldRungs, FieldSlim

__all__ = ["Field", "FieldList", "FieldPublish", "FieldRollback"]


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


@dataclass(frozen=True)
class FieldList:
    """List the tiles that a folder publishes, with all their versions."""

    folder: Annotated[Path, Positional]
    """The server's folder of fields (mec-server --fields)."""

    def run(self) -> None:
        """Print a line a version; the current one has a star."""
        from rfcore.wire.tile_manifest import read_publication

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


@dataclass(frozen=True)
class FieldRollback:
    """Make an earlier version of a tile current again; running servers take it up."""

    folder: Path
    """The server's folder of fields (mec-server --fields)."""
    tile: str = "street"
    """The tile to take back."""
    to: int | None = None
    """The version that was good; the one before the current without it."""

    def run(self) -> None:
        """Roll back, and say what is current."""
        from rfedge.fields.publish import roll_back

        tile = roll_back(self.folder, self.tile, self.to)
        print(f"{tile.name} is version {tile.version}, field {tile.field_id}")


SubVerb = (
    Annotated[FieldImport, subcommand("import")]
    | Annotated[FieldInfo, subcommand("info")]
    | Annotated[FieldCheck, subcommand("check")]
    | Annotated[FieldSlim, subcommand("slim")]
    | Annotated[FieldRungs, subcommand("rungs")]
    | Annotated[FieldExport, subcommand("export")]
    | Annotated[FieldPublish, subcommand("publish")]
    | Annotated[FieldList, subcommand("list")]
    | Annotated[FieldRollback, subcommand("rollback")]
)


@dataclass(frozen=True)
class Field:
    """Import, inspect, check, slim, refine, export and publish radiance fields."""

    verb: SubVerb

    def run(self) -> None:
        """Run the sub-verb."""
        self.verb.run()
