"""``rfedge-lab localise``: poses found again from wrong ones, tracking, and what errors cost.

Two kinds of rows: *starts* (``lab.localisation.measure``), searches from start errors
and from false starts, with the tracker's time beside; *bits*
(``lab.localisation.bits``). Each row is a cell (``rfedge.evaluate.cells``), kept
as it ends: the same command goes on where it was stopped. Cells share so many processes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfedge.arguments import JSON

__all__ = ["EvalLocalise"]

STARTS = ("0.5m:1deg", "1m:2deg", "2m:3deg", "4m:8deg")
ERRORS = ("white-small", "white-large", "offset", "gnss", "exact,silent_from_s=0.5,silent_s=5")
CRFS = (20.0, 25.0, 30.0, 35.0)


@dataclass(frozen=True)
class EvalLocalise:
    """Measure searches, tracking, and the bits that errors of measured poses cost."""

    drives: Annotated[tuple[str, ...], Positional, arg(metavar="NAME=DRIVE,FIELD[,KEY=VALUE...]")]
    """A name, posed pictures, a field; then units=, hz=, frames=, noise=, rows=starts|bits|2m:3deg,
    and feed=, feed_map=, map= (docs/how-to/localise.md)."""
    tries: int = 100
    """Searches of each start error."""
    false_starts: int = 50
    """Searches with pictures the field cannot have, of each start error."""
    strangers: tuple[Path, ...] = ()
    """Datasets of other places, whose pictures take part in false starts."""
    starts: tuple[str, ...] = STARTS
    """Start errors, METRESm:DEGREESdeg."""
    errors: tuple[str, ...] = ERRORS
    """Sensors, models of lab.localisation.pose_errors; lengths are metres."""
    frames: int | None = 24
    """Frames of a drive that are coded."""
    crfs: tuple[float, ...] = CRFS
    """Qualities at which bits are compared."""
    seed: int = 1
    """Seed of starts and errors."""
    threads: int = 1
    """Threads of the renderer; times are those of one core with 1."""
    processes: int = 1
    """Jobs at a time; no more than cores, or times mean nothing."""
    quick: bool = False
    """Six tries and false starts from one start error, two sensors on eight frames."""
    cells: Path = Path("out/eval/localise")
    """Finished rows; the same command goes on from there, another program measures anew."""
    out: Annotated[Path, JSON] = Path("out/eval/localise.json")
    """The result file to write."""

    def run(self) -> None:
        """Measure every drive and print each row as it is there.

        Raises ``InvalidInput`` for drives, starts and sensors of another form and for a number of
        processes that cannot be, before any work.
        """
        from lab.localisation.given import GivenDrive
        from lab.localisation.measure import pieces, rows_of_pieces
        from rfedge.evaluate.cells import check_processes
        from rfedge.results import check_result_path, make_result, provenance, write_result

        check_result_path(self.out)
        check_processes(self.processes)
        asked = _quick(self) if self.quick else self
        given = [GivenDrive.parse(text) for text in asked.drives]
        made = provenance(path for drive in given for path in (drive.field, drive.drive))
        rows = []
        for row in rows_of_pieces(pieces(asked, given), asked.cells, asked.processes):
            rows.append(row)
            print(row, flush=True)
        write_result(self.out, make_result("localise", made, {"rows": rows}))


def _quick(asked: EvalLocalise) -> EvalLocalise:
    return replace(
        asked,
        tries=6,
        false_starts=6,
        starts=("2m:3deg",),
        errors=("offset", "gnss"),
        frames=8,
        crfs=(25.0, 35.0),
    )
