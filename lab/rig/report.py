"""The rows of ``rfedge-lab rig``, and the tables that show them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from lab.report import Report, bars
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of


@dataclass(frozen=True)
class CameraRow:
    """One camera in one case."""

    case: str = field(metadata=shown("case"))
    """``one CRF`` or ``one delay``."""
    sessions: str = field(metadata=shown("sessions"))
    """``one`` for all cameras, or ``one each``."""
    camera: str = field(metadata=shown("camera"))
    captured: int
    acked: int
    payload_bytes: float = field(metadata=shown("slice bytes", ".0f"))
    """Mean size of a slice."""
    packet_bytes: float
    """Mean size of a message."""
    crf: float = field(metadata=shown("CRF", ".1f"))
    psnr_db: float | None = field(metadata=shown("PSNR dB", ".2f"))
    """Mean luma PSNR of what the server shows against the camera; None where it showed nothing."""
    latency_p50_ms: float | None
    latency_p99_ms: float | None


@dataclass(frozen=True)
class SessionRow:
    """All cameras of a case together."""

    case: str = field(metadata=shown("case"))
    sessions: str = field(metadata=shown("sessions"))
    cameras: int
    size_px: tuple[int, int]
    captured: int
    acked: int
    link_bytes: int
    """Everything that went up the link: frames, HTTP/2, Hello."""
    acked_bytes: int
    """Messages that became pictures."""
    psnr_mean_db: float | None = field(metadata=shown("PSNR dB", ".2f"))
    psnr_lowest_db: float | None = field(metadata=shown("lowest", ".2f"))
    """PSNR of the worst camera."""
    agent_mb: float = field(metadata=shown("agent MB", ".0f"))
    """Peak memory of the vehicle's processes, in sum."""
    instants: int | None = field(default=None, metadata=shown("whole instants"))
    """Number of instants that every camera showed; None where sessions have no instants."""
    spread_p50_ms: float | None = field(default=None, metadata=shown("spread p50 ms", ".0f"))
    """Time from the first to the last picture of an instant, as the server shows them."""
    spread_p99_ms: float | None = field(default=None, metadata=shown("spread p99 ms", ".0f"))
    most_instants_apart: int | None = field(default=None, metadata=shown("instants apart"))
    """Largest distance between the newest pictures of two cameras, at any time once each has shown
    one."""


ACKED = Column("acked", lambda row: (row.acked, row.captured), "{} of {}")
SHAPE = Column("cameras", lambda row: (row.cameras, *row.size_px), "{} x {}x{}")
LINK = Column("link kB", lambda row: row.link_bytes / 1e3, ".1f")
PICTURE = Column(
    "bytes a picture", lambda row: row.acked_bytes / row.acked if row.acked else None, ".0f"
)
SAME = ("case", "sessions")


def rig_parts(result: Result) -> Iterator[Table | str]:
    """Yield what all cameras of a case come to together, then each camera."""
    settings = result["settings"]
    yield (
        f"One link of {settings['link_bps'] / 1e6:g} Mbit/s for all sessions. *One CRF*: "
        f"{settings['crf']:g}, every picture answered before the next instant. *One delay*: "
        f"{settings['rate_hz']:g} instants a second within {settings['max_delay_ms']:g} ms from "
        "capture to Ack; pictures that could not be in time were dropped before they were coded. "
        "*Instants apart*: between the newest pictures that the server shows of any two cameras."
    )
    sessions = rows_of(SessionRow, result["sessions"])
    bits = (SHAPE, ACKED, LINK, PICTURE, "psnr_mean_db", "psnr_lowest_db")
    yield Table("Bits and quality", columns(SessionRow, *SAME, *bits), sessions)
    apart = ("instants", "spread_p50_ms", "spread_p99_ms", "most_instants_apart", "agent_mb")
    yield Table("Instants", columns(SessionRow, *SAME, SHAPE, *apart), sessions)
    own = ("camera", ACKED, "payload_bytes", "crf", "psnr_db", LATENCY)
    yield Table("Each camera", columns(CameraRow, *SAME, *own), rows_of(CameraRow, result["rows"]))


def _latency(row: CameraRow) -> tuple[float, float] | None:
    if row.latency_p50_ms is None or row.latency_p99_ms is None:
        return None
    return row.latency_p50_ms, row.latency_p99_ms


LATENCY = Column("p50 / p99 ms", _latency, "{:.0f} / {:.0f}")


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in rows_of(SessionRow, result["sessions"]):
        yield f"{row.cameras} cameras, {row.case}, {row.sessions} session", row.link_bytes / 1e3


REPORT = Report(
    "rig",
    "Several cameras in one session",
    "What it saves to send a vehicle's cameras in one session, and how far apart the pictures of "
    "an instant come.",
    rig_parts,
    bars("kB on the link", _bars),
)
