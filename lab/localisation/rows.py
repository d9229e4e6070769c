"""The rows of a result of kind ``localise``, and its section of the results page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rfedge.report.tables import cell, heading, table
from rfedge.results import Result, rows_of

__all__ = ["BitsRow", "LocaliseRow", "localise_section"]


@dataclass(frozen=True)
class LocaliseRow:
    """A drive's attempts at one start error; errors are over all poses that tries brought."""

    drive: str
    start_m: float
    start_deg: float
    tries: int
    false_starts: int
    localised_percent: float
    median_m: float | None
    median_deg: float | None
    p95_m: float | None
    false_percent: float
    """Poses that came back and are wrong, of all tries and false starts."""
    localise_ms: float
    """Median over the tries, features of the picture included; false starts take longer."""
    localise_cpu_ms: float | None
    """The same in processor time, which other work on the machine changes less."""
    track_cpu_ms: float | None = None
    """Median processor time of tracking a picture with all its renders, where it was measured,"""
    render_cpu_ms: float | None = None
    """and of a render alone in the same run."""
    false_cpu_ms: float | None = None
    """Median processor time of a false start."""


@dataclass(frozen=True)
class BitsRow:
    """What a sensor's errors cost on one drive."""

    drive: str
    pose_error: str
    bits_percent: float
    psnr_db: float
    """Of the drive at found poses, mean over the qualities coded."""
    tracked_percent: float
    localise_cpu_ms: float | None
    """Median processor time of a search."""
    track_cpu_ms: float
    """Median of the tracker with all its renders, of the frames in which no search was run."""
    render_cpu_ms: float
    """Median of a render in the same run."""


def localise_section(path: Path, result: Result) -> str:
    """Return the table of searches from wrong poses, and that of what errors of sensors cost."""
    bits = [row for row in result["rows"] if "pose_error" in row]
    starts = [row for row in result["rows"] if "pose_error" not in row]
    tables = (_table(LocaliseRow, starts), _table(BitsRow, bits))
    return "\n\n".join([heading(path, result), *tables, ""])


def _table(kind: type[Any], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows of ``kind`` under the names of its fields."""
    cells = [[_rounded(value) for value in vars(row).values()] for row in rows_of(kind, rows)]
    return table([field.name.replace("_", " ") for field in fields(kind)], cells)


def _rounded(value: Any) -> str:
    return cell(float(f"{value:.3g}")) if isinstance(value, float) else cell(value)
