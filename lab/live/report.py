"""The rows of the live experiment's result, and its section of the results page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rfedge.report.tables import cell, heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["AgeRow", "IngestRow", "SourceRow", "live_section", "print_live"]


@dataclass(frozen=True)
class AgeRow:
    """Pictures in a browser. Ages: from capture until it has the decoded picture; None: none came.

    ``drawing_ms``: what the last drawing of the street took, in software WebGL; where that is over
    1000 the street is drawn for a new view alone.
    """

    cameras: int
    hz: float
    seconds: float
    pictures: int
    median_ms: float | None
    p99_ms: float | None
    drawing_ms: float


@dataclass(frozen=True)
class IngestRow:
    """Time from due to Ack, without and with consumers and one browser, in turn on one server."""

    vehicles: int
    hz: float
    rounds: int
    consumers: int
    frames_alone: int
    frames_watched: int
    alone_median_ms: float | None
    alone_p99_ms: float | None
    watched_median_ms: float | None
    watched_p99_ms: float | None


@dataclass(frozen=True)
class SourceRow:
    """A live camera at 10 Hz. ``shown``: at a consumer of the twin.

    Memory is that of a process with its children, after a fifth of the run.
    """

    source: str
    seconds: float
    kills: int
    frames: int
    acked: int
    sender_report_percent: float
    ack_median_ms: float
    ack_p99_ms: float
    shown_median_ms: float
    shown_p99_ms: float
    agent_mb: float
    agent_mb_per_minute: float
    server_mb: float
    server_mb_per_minute: float
    threads_first: int
    threads_last: int


AGE_COLUMNS = ("cameras", "Hz", "pictures", "age: median ms", "p99 ms", "drawing ms")
INGEST_COLUMNS = (
    "vehicles",
    "Hz",
    "consumers",
    "frames",
    "median ms",
    "p99 ms",
    "watched: median ms",
    "watched: p99 ms",
)
SOURCE_COLUMNS = (
    "source",
    "s",
    "kills",
    "acked",
    "RTCP %",
    "to Ack: median ms",
    "p99 ms",
    "to consumer: median ms",
    "p99 ms",
    "agent MB",
    "MB/min",
    "server MB",
    "MB/min",
    "threads",
)
PARTS: tuple[tuple[str, type, tuple[str, ...], str], ...] = (
    ("ages", AgeRow, AGE_COLUMNS, "From capture until a browser shows it."),
    (
        "ingest",
        IngestRow,
        INGEST_COLUMNS,
        "From due to Ack, without and with consumers and a browser on the same machine.",
    ),
    ("sources", SourceRow, SOURCE_COLUMNS, "Live cameras at 10 Hz whose sender is killed."),
)


def live_section(path: Path, result: Result) -> str:
    """Return the tables that were measured."""
    parts = [heading(path, result)]
    for name, row_type, columns, text in PARTS:
        if result[name]:
            rows: list[Any] = rows_of(row_type, result[name])
            parts += [text, table(columns, [cells(row) for row in rows])]
    return "\n\n".join([*parts, ""])


def print_live(console: Console, rows: Sequence[Any]) -> None:
    """Print the rows of one part."""
    for _, row_type, columns, text in PARTS:
        if rows and isinstance(rows[0], row_type):
            print_table(console, text, columns, [cells(row) for row in rows])


def cells(row: AgeRow | IngestRow | SourceRow) -> list[str]:
    """Return a row's cells, in the order of its part's columns."""
    match row:
        case AgeRow():
            values: tuple[Any, ...] = (
                *(row.cameras, f"{row.hz:g}", row.pictures, _ms(row.median_ms), _ms(row.p99_ms)),
                f"{row.drawing_ms:.0f}",
            )
        case IngestRow():
            values = (
                *(row.vehicles, f"{row.hz:g}", row.consumers),
                f"{row.frames_alone} / {row.frames_watched}",
                *(_ms(row.alone_median_ms), _ms(row.alone_p99_ms)),
                *(_ms(row.watched_median_ms), _ms(row.watched_p99_ms)),
            )
        case SourceRow():
            values = (
                *(row.source, f"{row.seconds:g}", row.kills, f"{row.acked} of {row.frames}"),
                f"{row.sender_report_percent:.0f}",
                *(_ms(row.ack_median_ms), _ms(row.ack_p99_ms)),
                *(_ms(row.shown_median_ms), _ms(row.shown_p99_ms)),
                *(f"{row.agent_mb:.0f}", f"{row.agent_mb_per_minute:+.2f}"),
                *(f"{row.server_mb:.0f}", f"{row.server_mb_per_minute:+.2f}"),
                f"{row.threads_first} to {row.threads_last}",
            )
    return [cell(value) for value in values]


def _ms(value: float | None) -> str:
    return "none" if value is None else f"{value:.0f}"
