"""The rows of the never-worse experiment's result, and its section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["NeverWorseRow", "never_worse_section", "print_never_worse"]


@dataclass(frozen=True)
class NeverWorseRow:
    """One drive with one field, right or wrong, at one quality. CPU is the sender's, a frame."""

    scene: str
    hz: float
    frames: int
    control: str
    """Which field both ends hold."""
    preset: str
    at_db: float
    bytes: float
    """Of a whole message, header included, as all bytes here a mean over all frames but one."""
    header_bytes: float
    rival_bytes: float
    excess_percent: float
    """Bytes without the header over those of x264 at the same quality."""
    excess_percent_psnr_tuned: float
    """The same against x264 tuned for PSNR."""
    holds: bool
    first_frame_bytes: int
    rival_first_frame_bytes: int
    references: str
    """What most frames were predicted from."""
    cpu_ms: float
    rival_cpu_ms: float


COLUMNS = (
    "scene",
    "Hz",
    "field",
    "dB",
    "bytes",
    "of them header",
    "x264",
    "excess without header %",
    "against x264 tuned for PSNR %",
    "at most 2 %",
    "mostly predicted from",
    "CPU ms",
    "x264's",
)

PRINTED = ("scene", "Hz", "field", "dB", "excess %", "psnr-tuned", "holds", "references")


def never_worse_section(path: Path, result: Result) -> str:
    """Return the table; a field that made it worse stands out."""
    rows = map(_cells, rows_of(NeverWorseRow, result["rows"]))
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), ""])


def print_never_worse(console: Console, rows: Sequence[NeverWorseRow]) -> None:
    """Print the verdict on each field at each quality."""
    print_table(console, "A field against none", PRINTED, [_printed_cells(row) for row in rows])


def _printed_cells(row: NeverWorseRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        row.control,
        f"{row.at_db:g}",
        f"{row.excess_percent:.1f}",
        f"{row.excess_percent_psnr_tuned:.1f}",
        "yes" if row.holds else "NO",
        row.references,
    ]


def _cells(row: NeverWorseRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        row.control,
        f"{row.at_db:g}",
        f"{row.bytes:.0f}",
        f"{row.header_bytes:.0f}",
        f"{row.rival_bytes:.0f}",
        f"{row.excess_percent:+.1f}",
        f"{row.excess_percent_psnr_tuned:+.1f}",
        "yes" if row.holds else "**no**",
        row.references,
        f"{row.cpu_ms:.0f}",
        f"{row.rival_cpu_ms:.0f}",
    ]
