"""``rfedge bench``: correctness first, then time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

__all__ = ["Bench"]


@dataclass(frozen=True)
class Bench:
    """Check a part against its definition, then time it: medians of at least 20 repetitions."""

    case: Annotated[Literal["raster", "train", "codec", "ngp", "decoders"], Positional]
    """What to measure."""
    rows: Literal["all", "native", "modes"] = "all"
    """`native` leaves out the timing of the slow torch reference; `modes` shows what SH degree,
    antialiasing, depth and opacity cost, as ratios (raster only)."""
    field: Path | None = None
    """A trained hash grid of the sample street to time, instead of one learnt on the spot (ngp
    only)."""
    json: str | None = None
    """Write one JSON object to this file; `-` is standard output."""

    def run(self) -> None:
        """Run one case and print its rows."""
        from rfedge.bench import print_rows, run_case
        from rfedge.results import write_result

        result = run_case(self.case, rows=self.rows, field=self.field)
        if self.json is None:
            print_rows(result)
        else:
            write_result(self.json, result)
