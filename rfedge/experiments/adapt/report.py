"""The rows of the adaptation experiment's result, and its section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["AdaptRow", "adapt_section", "print_adapt"]


@dataclass(frozen=True)
class AdaptRow:
    """One drive coded in one way; None where a figure does not apply."""

    case: str
    drive: str
    frames: int
    variant: str
    kbit_33db: float
    """Kilobits a frame at a luma PSNR of 33 dB, the first frame apart."""
    x264_kbit_33db: float
    """The same of x264 tuned for PSNR."""
    recovered_percent: float | None
    """Of what the drive costs more than in the field's own light, with the variant ``off``."""
    noon_bits_percent: float | None
    """Bits more than ``off`` takes in the field's own light; other fields are not taken there."""
    second_vehicle_percent: float | None
    """A second vehicle's bytes a frame over the first one's, above those of the empty street."""
    side_bytes: int
    """Of the field or layer that the variant needs besides."""
    extra_ms: float
    """Processor time a frame of the sender, more than ``off`` takes."""


COLUMNS = (
    "case",
    "drive",
    "frames",
    "variant",
    "kbit at 33 dB",
    "x264",
    "against x264 %",
    "recovered %",
    "bits at noon %",
    "second vehicle %",
    "side bytes",
    "extra ms",
)


def adapt_section(path: Path, result: Result) -> str:
    """Return the table of the results page."""
    rows = map(_cells, rows_of(AdaptRow, result["rows"]))
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), ""])


def print_adapt(console: Console, rows: Sequence[AdaptRow]) -> None:
    """Print what each variant wins back."""
    print_table(console, "Another light", COLUMNS, [_cells(row) for row in rows])


def _cells(row: AdaptRow) -> list[str]:
    against = 100 * (row.kbit_33db / row.x264_kbit_33db - 1)
    return [
        row.case,
        row.drive,
        str(row.frames),
        row.variant,
        f"{row.kbit_33db:.1f}",
        f"{row.x264_kbit_33db:.1f}",
        f"{against:+.1f}",
        _percent(row.recovered_percent),
        _percent(row.noon_bits_percent),
        _percent(row.second_vehicle_percent),
        str(row.side_bytes),
        f"{row.extra_ms:+.1f}",
    ]


def _percent(value: float | None) -> str:
    return "n/a" if value is None else f"{value:+.1f}"
