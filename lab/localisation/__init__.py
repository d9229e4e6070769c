"""``rfedge-lab localise``: poses found again from wrong ones, tracking, and what errors cost.

There are two kinds of rows: *starts* (``lab.localisation.measure``) are searches from start
errors and from false starts, with the tracker's time beside; *bits* (``lab.localisation.bits``) say
what errors of measured poses cost. Each row is kept as it ends, so the same command goes on where
it was stopped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rfedge.evaluate import Experiment

__all__ = ["EvalLocalise"]

STARTS = ("0.5m:1deg", "1m:2deg", "2m:3deg", "4m:8deg")
ERRORS = ("white-small", "white-large", "offset", "gnss", "exact,silent_from_s=0.5,silent_s=5")
CRFS = (20.0, 25.0, 30.0, 35.0)


@dataclass(frozen=True, kw_only=True)
class EvalLocalise(Experiment):
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
    cells: Path = Path("out/eval/localise")
    out: Path = Path("out/eval/localise.json")

    def __post_init__(self) -> None:
        from rfedge.jobs import check_processes

        super().__post_init__()
        check_processes(self.processes)

    def run(self) -> None:
        """Measure every row that is not there yet, write the rows and print them."""
        from rich.console import Console

        from lab.localisation.measure import run_localise

        run_localise(_quick(self) if self.quick else self, Console())


def _quick(asked: EvalLocalise) -> EvalLocalise:
    """Return six tries and false starts from one start error, two sensors on eight frames."""
    return replace(
        asked,
        tries=6,
        false_starts=6,
        starts=("2m:3deg",),
        errors=("offset", "gnss"),
        frames=8,
        crfs=(25.0, 35.0),
    )
