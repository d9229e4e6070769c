"""The rows of ``rfedge eval world``, and their section of the results page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["Row", "print_world", "world_section"]

COLUMNS = ("case", "bound", "measured", "held")


@dataclass(frozen=True)
class Row:
    """A case of ``part``; ``held``: whether ``measured`` keeps ``bound``, None without a bound."""

    part: str
    case: str
    bound: str
    measured: str
    held: bool | None


def world_section(path: Path, result: Result) -> str:
    """Return the table."""
    notes = (
        "Objects and views of the twin against the generator's truth. *Distance from the outline*: "
        "of a vehicle on the ground, to where an object is told of. *Found*: by an object within "
        "2 m of the outline, a vehicle's first pictures included. *The empty minute*: the drive "
        "through the empty street again and again, each time with other noise. *Dusk*: the "
        "generator's evening, in the light that the field learnt from another pass. *Gain*: PSNR "
        "of a view less that of the field alone."
    )
    cells = [_cells(row) for row in rows_of(Row, result["rows"])]
    return "\n\n".join([heading(path, result), notes, table(COLUMNS, cells), ""])


def print_world(console: Console, result: Result) -> None:
    """Print the table."""
    cells = [_cells(row) for row in rows_of(Row, result["rows"])]
    print_table(console, "The twin against the truth", COLUMNS, cells)


def _cells(row: Row) -> list[str]:
    held = {True: "yes", False: "no", None: "-"}[row.held]
    return [f"{row.part}: {row.case}", row.bound or "-", row.measured, held]
