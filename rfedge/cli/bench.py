"""``rfedge bench``: correctness first, then time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from rfedge.arguments import FIELD

__all__ = ["Bench"]


@dataclass(frozen=True)
class Bench:
    """Check a part against its definition, then time it: medians of at least 20 repetitions."""

    case: Annotated[Literal["raster", "train", "codec", "ngp", "decoders"], Positional]
    """What to measure."""
    rows: Literal["all", "native", "modes"] = "all"
    """`native` leaves out the timing of the slow torch reference; `modes` shows what SH degree,
    antialiasing, depth and opacity cost, as ratios (raster only)."""
    field: Annotated[Path | None, FIELD] = None
    """A trained hash grid of the sample street to time, instead of one learnt on the spot (ngp
    only)."""
    json: Annotated[str | None, arg(metavar="FILE.json|-")] = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Run one case and print its rows."""
        from rfedge.arguments import field_path
        from rfedge.bench import print_rows, run_case, write_json

        field = field_path(self.field) if self.field is not None else None
        result = run_case(self.case, rows=self.rows, field=field)
        if self.json is None:
            print_rows(result)
        else:
            write_json(result, self.json)
