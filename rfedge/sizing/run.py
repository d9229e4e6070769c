"""``rfedge eval sizing`` from its drives to the tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfedge.experiments.cells import CellStore
from rfedge.experiments.clips import DriveName
from rfedge.results import check_result_path, make_result, provenance, write_result
from rfedge.sizing.estimate import Demand
from rfedge.sizing.measure import MIN_FRAMES, SETTLED_FRAMES, measured_cells, read_sized_drive
from rfedge.sizing.tables import SizingCell, SizingTables

__all__ = ["SizingJob", "own_tables", "run_sizing"]

STEPS = (1, 2, 3, 5)
"""Every n-th frame of a drive stands for a slower camera."""
SLOW_HZ = 5.0
"""Up to it pictures differ so much that what the first was coded better is of little use."""
SAME_RATE = 0.02


@dataclass(frozen=True)
class SizingJob:
    """What to measure; see ``rfedge eval sizing --help``."""

    drives: Sequence[DriveName]
    field: Path
    sizes_px: Sequence[tuple[int, int]]
    out: Path
    cells: Path
    quick: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)


@dataclass(frozen=True)
class Footage:
    """Frames of a drive that one cell of every codec is measured on."""

    drive: DriveName
    size_px: tuple[int, int]
    step: int
    frames: int

    @property
    def hz(self) -> float:
        """Pictures a second of the camera they stand for."""
        return self.drive.rate_hz / self.step


def run_sizing(job: SizingJob, console: Console) -> dict[str, Any]:
    """Measure what is not there yet, write ``job.out`` and return it."""
    field = load_field(job.field)
    store, made = CellStore(job.cells), provenance([job.field])
    cells: list[SizingCell] = []
    for footage in planned(job):
        console.print(f"  {_words(footage)}")
        cells += _measured(footage, field, store)
    streets = ", ".join(f"{drive.scene} at {drive.rate_hz:g} Hz" for drive in job.drives)
    content = {
        "measured_on": f"{streets}; field {field.field_id[:12]}",
        "quick": job.quick,
        "cells": cells,
    }
    result = make_result("sizing", made, content)
    write_result(job.out, result)
    return result


def planned(job: SizingJob) -> list[Footage]:
    """Return what is measured: each size and rate once, of the drive that has most frames of it."""
    best: dict[tuple[tuple[int, int], float], Footage] = {}
    for footage in _possible(job):
        other = best.get((footage.size_px, footage.hz))
        if other is None or footage.frames > other.frames:
            best[footage.size_px, footage.hz] = footage
    return sorted(best.values(), key=lambda f: (f.size_px, f.hz))


def _possible(job: SizingJob) -> Iterator[Footage]:
    for drive in job.drives:
        pictures = read_dataset(drive.dataset).pictures
        own = pictures[0].camera.intrinsics
        count = MIN_FRAMES if job.quick else len(pictures)
        for size_px in job.sizes_px:
            if size_px <= (own.width_px, own.height_px):
                for step in STEPS[:1] if job.quick else STEPS:
                    frames = -(-count // step)
                    slow = drive.rate_hz / step <= SLOW_HZ
                    if frames >= (MIN_FRAMES if slow or job.quick else SETTLED_FRAMES):
                        yield Footage(drive, size_px, step, frames)


def _measured(footage: Footage, field: RadianceField, store: CellStore) -> Iterator[SizingCell]:
    drive = read_sized_drive(footage.drive, footage.size_px, footage.frames * footage.step)
    yield from measured_cells(drive.every(footage.step), field, store)


def _words(footage: Footage) -> str:
    width_px, height_px = footage.size_px
    return f"{width_px}x{height_px} at {footage.hz:g} Hz: {footage.frames} frames"


def own_tables(
    dataset: Path, field: Path, demand: Demand, frames: int, cells: Path
) -> SizingTables:
    """Measure one cell of every codec on a user's drive at the size and rate of ``demand``.

    Every n-th frame is taken where the drive is faster. Raises ``InvalidInput`` where the drive's
    rate is no multiple of the wanted one, or its pictures are smaller.
    """
    own_hz = read_dataset(dataset).rate_hz or demand.hz
    step = max(round(own_hz / demand.hz), 1)
    if abs(own_hz / step / demand.hz - 1) > SAME_RATE:
        raise InvalidInput(
            "hz", f"{demand.hz:g} is not {own_hz:.3g} Hz, the rate of {dataset}, or a part of it"
        )
    name = DriveName(dataset.stem, demand.hz * step, dataset)
    drive = read_sized_drive(name, (demand.width_px, demand.height_px), frames * step)
    measured = measured_cells(drive.every(step), load_field(field), CellStore(cells))
    return SizingTables(tuple(measured), f"{dataset}; field {field}")
