"""Run the never-worse table over drives, with every fifth frame of some as a slow camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from rfcore.errors import InvalidInput
from rfcore.field import load_field
from rfedge.evaluate.cells import CellStore
from rfedge.evaluate.compare import seconds_left
from rfedge.evaluate.drives import DECIMATION, DriveFrames, DriveName, read_drive
from rfedge.evaluate.never_worse import NeverWorse, controls_of
from rfedge.evaluate.result_file import check_result_path, provenance, write_result
from rfedge.provenance import revision

__all__ = ["NeverWorseJob", "run_never_worse"]

QUICK_FRAMES = 6
Row = dict[str, Any]


@dataclass(frozen=True)
class NeverWorseJob:
    """What to run; see ``rfedge eval never-worse --help``."""

    field: Path
    drives: Sequence[str]
    decimated: Sequence[str]
    preset: str
    out: Path
    cells: Path
    quick: bool = False
    retime: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not (self.drives or self.decimated):
            raise InvalidInput("drives", "there is none")


def run_never_worse(job: NeverWorseJob, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    for text in (*job.drives, *job.decimated):
        DriveName.parse(text)
    field, stamp = load_field(job.field), revision()
    store = CellStore(job.cells)
    tables = [
        NeverWorse(drive, controls_of(field, drive), job.preset, stamp) for drive in _drives(job)
    ]
    left_s = sum(seconds_left(table.contest, table.coders.values(), store) for table in tables)
    console.print(f"{len(tables)} drives, about {left_s / 60:.1f} minutes left to do")
    rows = [row for table in tables for row in table.rows(store, retime=job.retime)]
    result = {
        "case": "never-worse",
        **provenance(stamp),
        "quick": job.quick,
        "field_id": field.field_id,
        "rows": rows,
    }
    write_result(job.out, result)
    _print(rows, console)
    return result


def _drives(job: NeverWorseJob) -> list[DriveFrames]:
    limit = QUICK_FRAMES if job.quick else None
    slow = [read_drive(text).every(DECIMATION) for text in job.decimated]
    return [*slow, *(read_drive(text, limit) for text in job.drives)]


def _print(rows: Sequence[Row], console: Console) -> None:
    table = Table("scene", "Hz", "field", "dB", "excess %", "psnr-tuned", "holds", "references")
    for row in rows:
        table.add_row(
            row["scene"],
            f"{row['hz']:g}",
            row["control"],
            f"{row['at_db']:g}",
            f"{row['excess_percent']:.1f}",
            f"{row['excess_percent_psnr_tuned']:.1f}",
            "yes" if row["holds"] else "NO",
            row["references"],
        )
    console.print(table)
