"""The rows of many different frames, as a section of the results page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["QUANTILES", "TailRow", "print_tail", "tail_section"]

QUANTILES = ("0.5", "0.99", "0.999", "0.9999", "0.99999")


@dataclass(frozen=True)
class TailRow:
    """How large one method's frames are, and what uplink carries every one of them in time."""

    method: str
    hz: float
    width_px: int
    height_px: int
    crf: float
    psnr_db: float
    frames: int
    drives: int
    mean_bytes: float
    quantile_bytes: Mapping[str, float]
    """By the share of the frames that are no larger."""
    largest_bytes: int
    uplink_bps_all_within: Mapping[str, float]
    """Lowest constant rate at which not one is late, by the budget in ms."""
    late_share_below: float
    """What may be claimed of that rate with 95 % confidence: the share of late frames is below."""


COLUMNS = (
    "method",
    "size",
    "Hz",
    "dB",
    "frames",
    "mean bytes",
    *(f"{100 * float(share):g} % <=" for share in QUANTILES),
    "largest",
    "uplink for all within 5 ms, kbit/s",
    "within 10 ms",
    "late, at most (95 %)",
)


def tail_section(path: Path, result: Result) -> str:
    """Return the table."""
    rows = [_cells(row) for row in rows_of(TailRow, result["rows"])]
    street = result["street"]
    note = (
        f"A field stands for the street: pictures of random drives along `{street['path']}`, noise "
        f"of {street['noise']:g} levels added; both ends hold {100 * street['detail']:g} % of its "
        "splats. All pictures differ. The first of each drive is left out."
    )
    return "\n\n".join([heading(path, result), note, table(COLUMNS, rows), ""])


def print_tail(console: Console, rows: Sequence[TailRow]) -> None:
    """Print the rows."""
    print_table(console, "Sizes of different frames", COLUMNS, [_cells(row) for row in rows])


def _cells(row: TailRow) -> list[str]:
    uplink = row.uplink_bps_all_within
    return [
        row.method,
        f"{row.width_px}x{row.height_px}",
        f"{row.hz:g}",
        f"{row.psnr_db:.2f}",
        f"{row.frames:,}",
        f"{row.mean_bytes:.0f}",
        *(f"{row.quantile_bytes[share]:.0f}" for share in QUANTILES),
        str(row.largest_bytes),
        *(f"{uplink[budget] / 1e3:.0f}" for budget in ("5", "10")),
        f"{100 * row.late_share_below:.4g} %",
    ]
