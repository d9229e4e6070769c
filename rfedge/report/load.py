"""The load test's section of the generated figures."""

from __future__ import annotations

from pathlib import Path

from rfedge.report.markdown_parts import Row, cell, heading, table

__all__ = ["load_section"]

COLUMNS = (
    "mode",
    "vehicles",
    "cameras",
    "hz",
    "link",
    "held",
    "p50_ms",
    "p99_ms",
    "on_time_percent",
    "on_time_at_least_percent",
    "fairness",
    "server_cores",
    "server_loop_cores",
    "vehicles_cores",
    "others_cores",
    "limited_by",
)


def load_section(path: Path, result: Row) -> str:
    """Return a table of the runs, with what was not kept and the commands below it."""
    rows = [[_shown(row, column) for column in COLUMNS] for row in result["rows"]]
    notes = [_note(row) for row in result["rows"]]
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), "\n".join(notes), ""])


def _shown(row: Row, column: str) -> str:
    if column == "link":
        return row["link"] or "loopback"
    if column == "held":
        return "yes" if row["held"] else "no"
    return cell(row[column])


def _note(row: Row) -> str:
    broken = f" Not kept: {'; '.join(row['broken'])}." if row["broken"] else ""
    size = f"{row['width']}x{row['height']}, {row['payload_bytes']:.0f} bytes of payload a frame"
    return f"* `{row['command']}` at `{row['revision']}` ({row['kind']} vehicles, {size}).{broken}"
