"""What the sections of the generated pages are made of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

__all__ = ["Row", "cell", "heading", "table"]

Row = Mapping[str, Any]


def heading(path: Path, result: Row) -> str:
    """Return a section's title with the command, revision and host of its result."""
    command = result.get("command") or f"rfedge bench {result['case']}"
    host = result["host"]
    return (
        f"## {path.stem}\n\n`{command}` at `{result['revision']}`; {host['cpu']}, "
        f"{host['cores']} cores, {host['isa']}."
    )


def cell(value: Any) -> str:
    """Return a value as a table shows it."""
    if value is None:
        return "not run"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 0.01 else f"{value:.2f}"
    return str(value)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, its first column aligned left and the others right."""
    lines = [list(columns), ["---", *["---:"] * (len(columns) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
