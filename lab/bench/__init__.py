"""``rfedge-lab bench``: each part is checked against its definition first and then timed.

A case is one module here, which declares its row as a dataclass; importing it is left to the run,
so that a case loads only what it measures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from rfcore.errors import InvalidInput
from rfedge.arguments import FIELD, field_path
from rfedge.results import Result, make_result, provenance, write_result

__all__ = ["CASES", "Bench", "Rows", "print_rows", "run_case"]

CASES = ("raster", "train", "codec", "ngp")
Rows = Literal["all", "native"]
"""Rows to run: ``native`` leaves out what only the slow reference fills in."""


@dataclass(frozen=True)
class Bench:
    """Check a part against its definition, then time it: medians of at least 20 repetitions."""

    case: Annotated[Literal["raster", "train", "codec", "ngp"], Positional]
    """The case to measure."""
    rows: Literal["all", "native"] = "all"
    """`native` leaves out the timing of the slow torch reference (raster only)."""
    field: Annotated[Path | None, FIELD] = None
    """A trained hash grid of the sample street to time, instead of one learnt on the spot (ngp
    only)."""
    isa: Annotated[str | None, arg(metavar="opencl[:DEVICE]")] = None
    """Measure this OpenCL device beside the CPU (raster only)."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Run one case and print its rows."""
        from rfcore.raster.renderers import is_opencl

        if self.isa is not None and (self.case != "raster" or not is_opencl(self.isa)):
            raise InvalidInput("isa", f"{self.isa!r}: `bench raster` takes opencl[:DEVICE]")
        field = field_path(self.field) if self.field is not None else None
        result = run_case(self.case, rows=self.rows, field=field, isa=self.isa)
        if self.json is None:
            print_rows(result)
        else:
            write_result(self.json, result)


def run_case(
    case: str, *, rows: Rows = "all", field: Path | None = None, isa: str | None = None
) -> dict[str, Any]:
    """Run one of ``CASES`` and return its result, of kind ``bench``.

    ``rows`` matters to ``raster`` alone, and so does ``isa``, an OpenCL device to be measured
    beside the CPU; ``field`` (an archive of the street) to ``ngp``.

    Raises ``InvalidInput`` for an unknown case, ``RfedgeError`` when a result is wrong.
    """
    made = provenance([] if field is None else [field])
    return make_result("bench", made, {"case": case, "rows": _rows_of(case, rows, field, isa)})


def _rows_of(case: str, rows: Rows, field: Path | None, isa: str | None) -> Sequence[object]:
    if case == "raster" and isa is not None:
        from lab.bench.raster import opencl_rows

        return opencl_rows(isa)
    if case == "raster":
        from lab.bench.raster import raster_rows

        return raster_rows(rows)
    if case == "train":
        from lab.bench.train import train_rows

        return train_rows()
    if case == "codec":
        from lab.bench.codec import codec_rows

        return codec_rows()
    if case == "ngp":
        from lab.bench.ngp import ngp_rows

        return ngp_rows(field)
    raise InvalidInput("case", f"{case!r} is not one of {', '.join(CASES)}")


def flattened(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row whose nested values stand beside the others, as ``outer inner``."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            flat |= {f"{name} {inner}": one for inner, one in value.items()}
        else:
            flat[name] = value
    return flat


def print_rows(result: Result) -> None:
    """Print the rows of a result as a table."""
    from rich.console import Console

    from rfedge.report.tables import Table, named_columns

    host = result["host"]
    title = f"{result['case']} at {result['revision']} on {host['cpu']} ({host['isa']})"
    rows = [flattened(row) for row in result["rows"]]
    Table(title, named_columns(rows[0]), rows).print(Console())
