"""Measure the rows of ``rfedge-lab localise``, and keep each with what it depends on."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from lab.localisation import EvalLocalise
from lab.localisation.bits import bits_row, sensors_of, tracking_times
from lab.localisation.false_starts import false_starts, row_of
from lab.localisation.given import GivenDrive
from lab.localisation.pose_errors import parse_error_model
from lab.localisation.rows import BitsRow, LocaliseRow
from lab.report import Report, bars
from rfcore.dataset import read_dataset
from rfcore.extras import needs
from rfcore.views import PosedPicture
from rfedge.evaluate.runner import Run, program_version
from rfedge.jobs import CellKey, CellStore, Job, Rows, Tell
from rfedge.localisation.searches import StartError, parse_start_error, searches_from_displaced
from rfedge.report.tables import Column, Table
from rfedge.results import Result, as_json, rows_of

with needs("localise"):
    import cv2


@dataclass(frozen=True)
class WantedRow:
    """A row to measure: searches of a drive from one start error, or its bits with one sensor."""

    given: GivenDrive
    start: StartError | None
    sensor: str | None
    tries: int
    false_starts: int
    strangers: tuple[Path, ...]
    frames: int | None
    crfs: tuple[float, ...]
    seed: int
    threads: int

    def key(self) -> CellKey:
        """Return what the row depends on."""
        own = {name: str(getattr(self, name)) for name in ("start", "sensor", "seed", "threads")}
        starts = {name: str(getattr(self, name)) for name in ("tries", "false_starts")}
        starts |= {str(path): _strangers_digest(path) for path in self.strangers}
        bits = {name: str(getattr(self, name)) for name in ("frames", "crfs")}
        return {
            "drive": _drive_digest(self.given),
            **own,
            **(starts if self.start is not None else bits),
            "program": program_version("lab/localisation"),
        }

    def rows(self) -> Rows:
        """Measure; one row."""
        cv2.setNumThreads(self.threads)
        if self.start is not None:
            return [as_json(_start_row(self, self.start))]
        assert self.sensor is not None
        asked = (self.frames, self.threads, self.seed)
        return [as_json(bits_row(self.given, self.sensor, self.crfs, asked))]


def rows_asked_for(asked: EvalLocalise, given: Sequence[GivenDrive]) -> list[WantedRow]:
    """Return the rows to measure, in their order.

    Raises ``InvalidInput`` for a start error or a sensor of another form.
    """
    starts = [parse_start_error(text) for text in asked.starts]
    for sensor in asked.errors:
        parse_error_model(sensor)
    found = []
    for drive in given:
        wanted: list[tuple[StartError | None, str | None]] = []
        if isinstance(drive.rows, StartError):
            wanted += [(drive.rows, None)]
        elif drive.rows != "bits":
            wanted += [(start, None) for start in starts]
        if drive.rows in ("bits", "both"):
            wanted += [(None, sensor) for sensor in sensors_of(drive, asked.errors)]
        found += [_wanted(asked, drive, *what) for what in wanted]
    return found


def _wanted(
    asked: EvalLocalise, given: GivenDrive, start: StartError | None, sensor: str | None
) -> WantedRow:
    return WantedRow(
        given,
        start,
        sensor,
        asked.tries,
        asked.false_starts,
        asked.strangers,
        asked.frames,
        asked.crfs,
        asked.seed,
        asked.threads,
    )


def run_localise(asked: EvalLocalise, console: Console) -> dict[str, Any]:
    """Measure every row that is not there yet, write the result and print its rows.

    Raises ``InvalidInput`` for drives, starts and sensors of another form before any work.
    """
    given = [GivenDrive.parse(text) for text in asked.drives]
    files = [path for drive in given for path in (drive.field, drive.drive)]
    run, wanted = Run.begin("localise", asked, files, console), rows_asked_for(asked, given)
    jobs = [
        Job(f"row-{number}", partial(_measure, row, asked.cells))
        for number, row in enumerate(wanted, 1)
    ]
    run.parallel(jobs, asked.processes)
    rows = []
    for each in wanted:
        rows += run.store.rows(each.key(), each.rows)
        run.tell(str(rows[-1]))
    return run.finish({"rows": rows}, localise_parts)


def _measure(wanted: WantedRow, cells: Path, _tell: Tell) -> None:
    CellStore(cells).rows(wanted.key(), wanted.rows)


def _start_row(wanted: WantedRow, error: StartError) -> LocaliseRow:
    """Return the row of one start error; lengths of the row are metres."""
    given = wanted.given
    field, pictures = given.read(wanted.threads)
    scaled = StartError(error.position_m * given.units, error.rotation_deg)
    strangers = [picture for path in wanted.strangers for picture in _strangers(path)]
    rng, last = np.random.default_rng(wanted.seed), wanted.tries + wanted.false_starts
    tries = list(searches_from_displaced(field, pictures, scaled, wanted.tries, rng))
    numbers = range(wanted.tries, last)
    false = list(false_starts(field, pictures, scaled, numbers, rng, strangers))
    row = row_of(given.name, error, tries, false)
    median_m, p95_m = (
        None if value is None else value / given.units for value in (row.median_m, row.p95_m)
    )
    track_cpu_ms, render_cpu_ms = tracking_times(given, wanted.threads, wanted.seed)
    return replace(
        row,
        median_m=median_m,
        p95_m=p95_m,
        track_cpu_ms=track_cpu_ms,
        render_cpu_ms=render_cpu_ms,
    )


@cache
def _strangers(path: Path) -> tuple[PosedPicture, ...]:
    return tuple(read_dataset(path, distortion="undistort").pictures)


@cache
def _strangers_digest(path: Path) -> str:
    """Return the digest of the pictures' names and cameras; their pixels are of no interest."""
    named = repr([(picture.name, picture.camera) for picture in _strangers(path)])
    return hashlib.sha256(named.encode()).hexdigest()


@cache
def _drive_digest(given: GivenDrive) -> str:
    """Return the digest of a drive: its text, its field, its pictures and poses, its feed."""
    total = hashlib.sha256(repr(given).encode())
    for path in (given.field, given.feed, given.feed_map, given.map):
        if path is not None:
            total.update(_file_digest(path).encode())
    for picture in given.read(1)[1]:
        total.update(repr((picture.name, picture.camera, picture.time_ns)).encode())
        total.update(picture.read().tobytes())
    return total.hexdigest()


@cache
def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


START = ("drive", "start_m", "start_deg")
FOUND = ("localised_percent", "median_m", "median_deg", "p95_m", "false_percent")
TIMES = ("localise_ms", "localise_cpu_ms", "track_cpu_ms", "render_cpu_ms", "false_cpu_ms")


def localise_parts(result: Result) -> Iterator[Table | str]:
    """Yield the searches from wrong poses, and what errors of sensors cost."""
    starts = rows_of(LocaliseRow, [row for row in result["rows"] if "pose_error" not in row])
    if starts:
        counts = f"{starts[0].tries} tries and {starts[0].false_starts} false starts"
        yield Table(f"Poses found, {counts} of each start error", _named(*START, *FOUND), starts)
        yield Table("Times of a search, of tracking, of a render", _named(*START, *TIMES), starts)
    bits = rows_of(BitsRow, [row for row in result["rows"] if "pose_error" in row])
    if bits:
        yield Table("Bits at the poses found, against the dataset's", _named(*vars(bits[0])), bits)


def _named(*names: str) -> list[Column]:
    """Return columns under the names of fields."""
    return [Column(name.replace("_", " "), _rounded(name)) for name in names]


def _rounded(name: str) -> Callable[[Any], Any]:
    """Return what gives a row's value to three digits."""

    def value(row: object) -> Any:
        found = getattr(row, name)
        return float(f"{found:.3g}") if isinstance(found, float) else found

    return value


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in result["rows"]:
        if "pose_error" in row:
            yield f"{row['drive']}, {row['pose_error']}", row["bits_percent"]


REPORT = Report(
    "localise",
    "Poses found in the field",
    "How often a pose is found again from a wrong one, how far off it is, and what errors of "
    "measured poses cost in bits.",
    localise_parts,
    bars("more bits than at the dataset's poses, %", _bars),
)
