"""One benchmark run as one JSON object: case, host, revision, rows.

What a benchmark row is: a flat or once nested mapping, ready for JSON or a table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Literal

from rfcore.errors import InvalidInput
from rfcore.files import write_whole
from rfedge.results import host, revision

__all__ = ["CASES", "Row", "Rows", "flattened", "print_rows", "run_case", "write_json"]


Row = dict[str, Any]
Rows = Literal["all", "native", "modes"]
"""Which rows to run: ``native`` leaves out what only the slow reference fills in, ``modes`` are
the specialisations of the renderer instead."""


def flattened(row: Row) -> Row:
    """Return a row whose nested values stand beside the others, as ``outer.inner``."""
    flat: Row = {}
    for name, value in row.items():
        if isinstance(value, dict):
            flat.update({f"{name}.{inner}": ms for inner, ms in value.items()})
        else:
            flat[name] = value
    return flat


CASES = ("raster", "train", "codec", "ngp", "decoders")


def run_case(case: str, *, rows: Rows = "all", field: Path | None = None) -> dict[str, Any]:
    """Run one of ``CASES`` and return its result.

    ``rows`` matters to ``raster`` alone, ``field`` (an archive of the street) to ``ngp``.

    Raises ``InvalidInput`` for an unknown case, ``RfedgeError`` when a result is wrong.
    """
    return {
        "case": case,
        "host": host(),
        "revision": revision(),
        "rows": _rows_of(case, rows, field),
    }


def _rows_of(case: str, rows: Rows, field: Path | None) -> list[Row]:
    if case == "raster":
        from rfedge.bench.raster import raster_rows

        return raster_rows(rows)
    if case == "train":
        from rfedge.bench.train import train_rows

        return train_rows()
    if case == "codec":
        from rfedge.bench.codec import codec_rows

        return codec_rows()
    if case == "ngp":
        from rfedge.bench.ngp import ngp_rows

        return ngp_rows(field)
    if case == "decoders":
        from rfedge.bench.decoders import decoder_rows

        return decoder_rows()
    raise InvalidInput("case", f"{case!r} is not one of {', '.join(CASES)}")


def print_rows(result: dict[str, Any]) -> None:
    """Print the rows of a result as a table."""
    from rich.console import Console
    from rich.table import Table

    where = result["host"]
    title = f"{result['case']} at {result['revision']} on {where['cpu']} ({where['isa']})"
    rows = [flattened(row) for row in result["rows"]]
    table = Table(title=title)
    for name in rows[0]:
        table.add_column(name, justify="right", overflow="fold")
    for row in rows:
        table.add_row(*(_cell(value) for value in row.values()))
    Console().print(table)


def write_json(result: dict[str, Any], path: str) -> None:
    """Write a result to ``path``, or to standard output for ``-``."""
    text = json.dumps(result, indent=2) + "\n"
    if path == "-":
        sys.stdout.write(text)
    else:
        write_whole(Path(path), text)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
