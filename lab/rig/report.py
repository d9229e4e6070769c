"""The rows of ``rfedge-lab rig``, and their section of the results page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, rows_of

__all__ = ["CameraRow", "SessionRow", "print_rig", "rig_section"]


@dataclass(frozen=True)
class CameraRow:
    """One camera in one case."""

    case: str
    """``one CRF`` or ``one delay``."""
    sessions: str
    """``one`` for all cameras, or ``one each``."""
    camera: str
    captured: int
    acked: int
    payload_bytes: float
    """Mean of a slice."""
    packet_bytes: float
    """Mean of a message."""
    crf: float
    psnr_db: float | None
    """Mean luma PSNR of what the server shows against the camera; None where it showed nothing."""
    latency_p50_ms: float | None
    latency_p99_ms: float | None


@dataclass(frozen=True)
class SessionRow:
    """All cameras of a case together."""

    case: str
    sessions: str
    cameras: int
    size_px: tuple[int, int]
    captured: int
    acked: int
    link_bytes: int
    """Everything that went up the link: frames, HTTP/2, Hello."""
    acked_bytes: int
    """Messages that became pictures."""
    psnr_mean_db: float | None
    psnr_lowest_db: float | None
    """PSNR of the worst camera."""
    agent_mb: float
    """Peak memory of the vehicle's processes, in sum."""
    instants: int | None = None
    """Number of instants that every camera showed; None where sessions have no instants."""
    spread_p50_ms: float | None = None
    """Time from the first to the last picture of an instant, as the server shows them."""
    spread_p99_ms: float | None = None
    most_instants_apart: int | None = None
    """Largest distance between the newest pictures of two cameras, at any time once each has shown
    one."""


CAMERAS = (
    "case",
    "sessions",
    "camera",
    "acked",
    "slice bytes",
    "CRF",
    "PSNR dB",
    "p50 ms",
    "p99 ms",
)
SESSIONS = (
    "case",
    "sessions",
    "cameras",
    "acked",
    "link kB",
    "bytes a picture",
    "PSNR dB",
    "lowest",
    "agent MB",
    "whole instants",
    "spread p50 ms",
    "p99 ms",
    "instants apart",
)


def rig_section(path: Path, result: Result) -> str:
    """Return the tables."""
    settings = result["settings"]
    notes = (
        f"One link of {settings['link_bps'] / 1e6:g} Mbit/s for all sessions. *One CRF*: "
        f"{settings['crf']:g}, every picture answered before the next instant. *One delay*: "
        f"{settings['rate_hz']:g} instants a second within {settings['max_delay_ms']:g} ms from "
        "capture to Ack; pictures that could not be in time were dropped before they were coded. "
        "*Instants apart*: between the newest pictures that the server shows of any two cameras."
    )
    sessions = [_session_cells(row) for row in rows_of(SessionRow, result["sessions"])]
    cameras = [_camera_cells(row) for row in rows_of(CameraRow, result["rows"])]
    parts = [heading(path, result), notes, table(SESSIONS, sessions), table(CAMERAS, cameras), ""]
    return "\n\n".join(parts)


def print_rig(console: Console, result: Result) -> None:
    """Print both tables."""
    cameras = [_camera_cells(row) for row in rows_of(CameraRow, result["rows"])]
    print_table(console, "Cameras", CAMERAS, cameras)
    sessions = [_session_cells(row) for row in rows_of(SessionRow, result["sessions"])]
    print_table(console, "Sessions", SESSIONS, sessions)


def _camera_cells(row: CameraRow) -> list[str]:
    return [
        row.case,
        row.sessions,
        row.camera,
        f"{row.acked} of {row.captured}",
        f"{row.payload_bytes:.0f}",
        f"{row.crf:.1f}",
        _number(row.psnr_db, 2),
        _number(row.latency_p50_ms, 0),
        _number(row.latency_p99_ms, 0),
    ]


def _session_cells(row: SessionRow) -> list[str]:
    width_px, height_px = row.size_px
    return [
        row.case,
        row.sessions,
        f"{row.cameras} x {width_px}x{height_px}",
        f"{row.acked} of {row.captured}",
        f"{row.link_bytes / 1000:.1f}",
        _number(row.acked_bytes / row.acked if row.acked else None, 0),
        _number(row.psnr_mean_db, 2),
        _number(row.psnr_lowest_db, 2),
        f"{row.agent_mb:.0f}",
        "-" if row.instants is None else str(row.instants),
        _number(row.spread_p50_ms, 0),
        _number(row.spread_p99_ms, 0),
        "-" if row.most_instants_apart is None else str(row.most_instants_apart),
    ]


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"
