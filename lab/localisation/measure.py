"""The rows of ``rfedge-lab localise``: which ones are measured, what they depend on, and how."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.localisation.bits import bits_row, sensors_of, tracking_times
from lab.localisation.false_starts import false_starts, row_of
from lab.localisation.given import GivenDrive
from lab.localisation.pose_errors import parse_error_model
from lab.localisation.rows import LocaliseRow
from rfcore.dataset import read_dataset
from rfcore.extras import needs
from rfcore.views import PosedPicture
from rfedge.evaluate.cells import CellKey, CellStore, Rows, each_done, program_version
from rfedge.localisation.searches import StartError, parse_start_error, searches_from_displaced
from rfedge.results import as_json

with needs("localise"):
    import cv2

if TYPE_CHECKING:
    from lab.localisation import EvalLocalise

__all__ = ["Piece", "pieces", "rows_of_pieces"]


@dataclass(frozen=True)
class Piece:
    """One row: searches of a drive from one start error, or its bits with one sensor."""

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
            "program": program_version(),
        }

    def rows(self) -> Rows:
        """Measure; one row."""
        cv2.setNumThreads(self.threads)
        if self.start is not None:
            return [as_json(_start_row(self, self.start))]
        assert self.sensor is not None
        asked = (self.frames, self.threads, self.seed)
        return [as_json(bits_row(self.given, self.sensor, self.crfs, asked))]


def pieces(asked: EvalLocalise, given: Sequence[GivenDrive]) -> list[Piece]:
    """Return the rows that are asked for, in their order.

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
        found += [_piece(asked, drive, *what) for what in wanted]
    return found


def _piece(
    asked: EvalLocalise, given: GivenDrive, start: StartError | None, sensor: str | None
) -> Piece:
    return Piece(
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


def rows_of_pieces(wanted: Sequence[Piece], cells: Path, processes: int) -> Iterator[Any]:
    """Yield the rows, in their order, from the folder of cells or measured and kept there."""
    for rows in each_done(partial(_kept_rows, cells=cells), wanted, processes):
        yield from rows


def _kept_rows(piece: Piece, cells: Path) -> Rows:
    return CellStore(cells).rows(piece.key(), piece.rows)


def _start_row(piece: Piece, error: StartError) -> LocaliseRow:
    """Return the row of one start error; lengths of the row are metres."""
    given = piece.given
    field, pictures = given.read(piece.threads)
    scaled = StartError(error.position_m * given.units, error.rotation_deg)
    strangers = [picture for path in piece.strangers for picture in _strangers(path)]
    rng, last = np.random.default_rng(piece.seed), piece.tries + piece.false_starts
    tries = list(searches_from_displaced(field, pictures, scaled, piece.tries, rng))
    numbers = range(piece.tries, last)
    false = list(false_starts(field, pictures, scaled, numbers, rng, strangers))
    row = row_of(given.name, error, tries, false)
    median_m, p95_m = (
        None if value is None else value / given.units for value in (row.median_m, row.p95_m)
    )
    track_cpu_ms, render_cpu_ms = tracking_times(given, piece.threads, piece.seed)
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
    """Return the digest of which pictures they are, not of their pixels: any other place does."""
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
