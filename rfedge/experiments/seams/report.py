"""The rows of a drive across tiles, as a section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["SeamRow", "print_seams", "seams_section"]


@dataclass(frozen=True)
class SeamRow:
    """Frames of one kind: bits at one quality and the renders' own, with one field and in tiles."""

    scene: str
    hz: float
    frames_are: str
    """``near a seam``, ``elsewhere`` or ``all``."""
    frames: int
    new_streams: int
    """Of them, how many are the first of a tile."""
    whole_kbit: float
    tiles_kbit: float
    more_percent: float
    whole_render_db: float
    tiles_render_db: float


COLUMNS = (
    "scene",
    "Hz",
    "frames",
    "of them first of a tile",
    "kbit a frame, one field",
    "tiles",
    "more %",
    "render dB, one field",
    "tiles",
)


def seams_section(path: Path, result: Result) -> str:
    """Return the table."""
    rows = [_cells(row) for row in rows_of(SeamRow, result["rows"])]
    street = result["street"]
    note = (
        f"A drive across {street['tiles']} tiles; near a seam: within {street['within_m']:g} m of "
        f"another tile's ground. Bits at {street['quality_db']:g} dB. One field has "
        f"{street['whole_bytes'] / 1e6:.1f} MB, the tiles {street['tiles_bytes'] / 1e6:.1f} MB "
        "together."
    )
    return "\n\n".join([heading(path, result), note, table(COLUMNS, rows), ""])


def print_seams(console: Console, rows: Sequence[SeamRow]) -> None:
    """Print the rows."""
    print_table(console, "One field and tiles", COLUMNS, [_cells(row) for row in rows])


def _cells(row: SeamRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        f"{row.frames} {row.frames_are}",
        str(row.new_streams),
        f"{row.whole_kbit:.2f}",
        f"{row.tiles_kbit:.2f}",
        f"{row.more_percent:+.1f}",
        f"{row.whole_render_db:.2f}",
        f"{row.tiles_render_db:.2f}",
    ]
