"""``rfedge field rollback``: an earlier version of a tile again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["FieldRollback"]


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
