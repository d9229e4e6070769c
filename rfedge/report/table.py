"""The summary table on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from rfedge.report.summary import SUMMARY

__all__ = ["print_table"]


def print_table(console: Console, result: Mapping[str, Any], out: Path) -> None:
    """Print the report's summary table and where the files are."""
    sequences = result["sequences"]
    table = Table(title="Vehicle to edge server", title_justify="left")
    table.add_column("")
    for name in sequences:
        table.add_column(name, justify="right")
    for label, note, show in SUMMARY:
        table.add_row(f"{label}\n[dim]{note}[/]", *(show(entry) for entry in sequences.values()))
    console.print(table)
    for name in ("report.html", "reconstructed.mp4", "result.json"):
        console.print(f"  {out / name}")
