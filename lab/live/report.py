"""The rows of the live experiment's result, and the tables that show them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from lab.report import Report, bars
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of


@dataclass(frozen=True)
class AgeRow:
    """Pictures in a browser. Ages are from capture until it has the decoded picture; None if none
    came.

    ``drawing_ms``: what the last drawing of the street took, in software WebGL; where that is over
    1000 the street is drawn for a new view alone.
    """

    cameras: int = field(metadata=shown("cameras"))
    hz: float = field(metadata=shown("Hz", "g"))
    seconds: float
    pictures: int = field(metadata=shown("pictures"))
    median_ms: float | None = field(metadata=shown("age p50 ms", ".0f", "none"))
    p99_ms: float | None = field(metadata=shown("p99 ms", ".0f", "none"))
    drawing_ms: float = field(metadata=shown("drawing ms", ".0f"))


@dataclass(frozen=True)
class IngestRow:
    """Time from due to Ack, without and with consumers and one browser, in turn on one server."""

    vehicles: int = field(metadata=shown("vehicles"))
    hz: float = field(metadata=shown("Hz", "g"))
    rounds: int
    consumers: int = field(metadata=shown("consumers"))
    frames_alone: int
    frames_watched: int
    alone_median_ms: float | None = field(metadata=shown("alone: p50 ms", ".0f", "none"))
    alone_p99_ms: float | None = field(metadata=shown("p99 ms", ".0f", "none"))
    watched_median_ms: float | None = field(metadata=shown("watched: p50 ms", ".0f", "none"))
    watched_p99_ms: float | None = field(metadata=shown("watched: p99 ms", ".0f", "none"))


@dataclass(frozen=True)
class SourceRow:
    """A live camera at 10 Hz; ``shown`` means shown at a consumer of the twin.

    Memory is that of a process with its children, after a fifth of the run.
    """

    source: str = field(metadata=shown("source"))
    seconds: float = field(metadata=shown("s", "g"))
    kills: int = field(metadata=shown("kills"))
    frames: int
    acked: int
    sender_report_percent: float = field(metadata=shown("RTCP %", ".0f"))
    ack_median_ms: float = field(metadata=shown("to Ack: p50 ms", ".0f"))
    ack_p99_ms: float = field(metadata=shown("Ack p99 ms", ".0f"))
    shown_median_ms: float = field(metadata=shown("to consumer: p50 ms", ".0f"))
    shown_p99_ms: float = field(metadata=shown("consumer p99 ms", ".0f"))
    agent_mb: float = field(metadata=shown("agent MB", ".0f"))
    agent_mb_per_minute: float = field(metadata=shown("agent MB/min", "+.2f"))
    server_mb: float = field(metadata=shown("server MB", ".0f"))
    server_mb_per_minute: float = field(metadata=shown("server MB/min", "+.2f"))
    threads_first: int
    threads_last: int


FRAMES = Column("frames", lambda row: (row.frames_alone, row.frames_watched), "{} / {}")
ACKED = Column("acked", lambda row: (row.acked, row.frames), "{} of {}")
THREADS = Column("threads", lambda row: (row.threads_first, row.threads_last), "{} to {}")
LATENCIES = ("ack_median_ms", "ack_p99_ms", "shown_median_ms", "shown_p99_ms")
MEMORY = ("agent_mb", "agent_mb_per_minute", "server_mb", "server_mb_per_minute")


def live_parts(result: Result) -> Iterator[Table | str]:
    """Yield the parts that were measured; others may be missing or empty."""
    ages = rows_of(AgeRow, result.get("ages", ()))
    if ages:
        yield Table("From capture until a browser shows it", columns(AgeRow), ages)
    ingest = rows_of(IngestRow, result.get("ingest", ()))
    if ingest:
        title = "From due to Ack, without and with consumers and a browser on the same machine"
        yield Table(title, [FRAMES, *columns(IngestRow)], ingest)
    sources = rows_of(SourceRow, result.get("sources", ()))
    if sources:
        made = columns(SourceRow, "source", "seconds", "kills", ACKED, *LATENCIES)
        yield Table("Live cameras at 10 Hz whose sender is killed", made, sources)
        made = columns(SourceRow, "source", "sender_report_percent", *MEMORY, THREADS)
        yield Table("Their clocks, memory and threads", made, sources)


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    rows: Mapping[str, float | None] = {
        f"{row.cameras} cameras at {row.hz:g} Hz": row.median_ms
        for row in rows_of(AgeRow, result["ages"])
    }
    yield from ((name, ms) for name, ms in rows.items() if ms is not None)


REPORT = Report(
    "live",
    "The live twin in a browser",
    "How old a picture is when a browser shows it, what showing costs the server, and how live "
    "cameras come back.",
    live_parts,
    bars("age of a picture when shown, median ms", _bars),
)
