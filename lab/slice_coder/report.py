"""The rows of the slice coder experiment's result, and its section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["BdRow", "TimeRow", "print_slice_coder", "slice_coder_section"]


@dataclass(frozen=True)
class BdRow:
    """How many percent more bytes an effort needs than an x264 preset, over all of both curves."""

    drive: str
    hz: float
    width: int
    height: int
    effort: str
    rival: str
    bd_rate_percent: float


@dataclass(frozen=True)
class TimeRow:
    """Times of a slice, mean over frames and CRFs of the least of a few repetitions.

    ``encode_ms``: of the processor, all threads together; ``wall_ms``: of the clock, none in
    results from before it was measured. ``x264_*``: x264 medium's, which codes the references
    before it, in the same run.
    """

    width: int
    height: int
    references: int
    threads: int
    effort: str
    encode_ms: float
    x264_encode_ms: float
    wall_ms: float | None = None
    x264_wall_ms: float | None = None


BD_COLUMNS = ("drive", "Hz", "size", "effort", "against x264", "BD-rate %")
TIME_COLUMNS = (
    "size",
    "references",
    "threads",
    "effort",
    "ms",
    "x264 medium ms",
    "ratio",
    "ms of the clock",
    "x264 medium",
)


def slice_coder_section(path: Path, result: Result) -> str:
    """Return both tables."""
    bd, times = rows_of(BdRow, result["rows"]), rows_of(TimeRow, result["times"])
    return "\n\n".join(
        [
            heading(path, result),
            table(BD_COLUMNS, map(_bd_cells, bd)),
            table(TIME_COLUMNS, map(_time_cells, times)),
            "",
        ]
    )


def print_slice_coder(console: Console, bd: Sequence[BdRow], times: Sequence[TimeRow]) -> None:
    """Print both tables."""
    print_table(console, "BD-rate at equal references", BD_COLUMNS, [_bd_cells(r) for r in bd])
    if times:
        print_table(console, "Processor time", TIME_COLUMNS, [_time_cells(r) for r in times])


def _bd_cells(row: BdRow) -> list[str]:
    return [
        row.drive,
        f"{row.hz:g}",
        f"{row.width}x{row.height}",
        row.effort,
        row.rival,
        f"{row.bd_rate_percent:+.1f}",
    ]


def _time_cells(row: TimeRow) -> list[str]:
    return [
        f"{row.width}x{row.height}",
        str(row.references),
        str(row.threads),
        row.effort,
        f"{row.encode_ms:.1f}",
        f"{row.x264_encode_ms:.1f}",
        f"{row.encode_ms / row.x264_encode_ms:.2f}",
        _ms(row.wall_ms),
        _ms(row.x264_wall_ms),
    ]


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
