"""``rfedge-lab size-tables``: measure the tables that ``rfedge size`` ships with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional

from rfcore.dataset import read_dataset
from rfcore.field import load_field
from rfedge.arguments import field_path, parse_size
from rfedge.evaluate import Experiment
from rfedge.evaluate.clips import DriveName
from rfedge.evaluate.runner import Run
from rfedge.samples import sample_path
from rfedge.sizing.measure import MIN_FRAMES, SETTLED_FRAMES, measured_cells, read_sized_drive
from rfedge.sizing.tables import SizingCell

SAMPLE = f"vehicles@10={sample_path('street/transforms_drive_vehicles.json')}"
STEPS = (1, 2, 3, 5)
"""Every n-th frame of a drive stands for a slower camera."""
SLOW_HZ = 5.0
"""Up to this rate pictures differ so much that a good key frame helps the next ones little."""


@dataclass(frozen=True)
class Footage:
    """Frames of a drive that one cell of every codec is measured on."""

    drive: DriveName
    size_px: tuple[int, int]
    step: int
    frames: int

    @property
    def hz(self) -> float:
        """Pictures a second of the camera that the frames stand for."""
        return self.drive.rate_hz / self.step


@dataclass(frozen=True, kw_only=True)
class EvalSizing(Experiment):
    """Measure the tables of `rfedge size`: bytes and processor time by size, rate and quality.

    Goes on where it was stopped, cell by cell.
    """

    drives: Annotated[tuple[str, ...], Positional] = (SAMPLE,)
    """NAME@HZ=DATASET for each drive; every second, third and fifth frame stand for slower
    cameras."""
    field: Path = sample_path("fields/street.rff")
    """The field archive (.rff) both ends hold."""
    sizes: tuple[str, ...] = ("320x180", "640x360", "1920x1080")
    """WIDTHxHEIGHT that the pictures are reduced to, as far as a drive is that large."""
    out: Path = Path("out/eval/sizing.json")
    cells: Path = Path("out/eval/sizing")

    def run(self) -> None:
        """Measure what is not there yet and write the tables."""
        self.measure(Console())

    def measure(self, console: Console) -> dict[str, Any]:
        """Measure what is not there yet, write the result and return it."""
        path = field_path(self.field)
        run, field = Run.begin("sizing", self, [path], console), load_field(path)
        cells: list[SizingCell] = []
        for footage in self.planned():
            (width_px, height_px), step = footage.size_px, footage.step
            run.tell(f"  {width_px}x{height_px} at {footage.hz:g} Hz: {footage.frames} frames")
            drive = read_sized_drive(footage.drive, footage.size_px, footage.frames * step)
            cells += measured_cells(drive.every(step), field, run.store)
        streets = ", ".join(f"{name.scene} at {name.rate_hz:g} Hz" for name in self._names())
        measured_on = f"{streets}; field {field.field_id[:12]}"
        return run.finish({"measured_on": measured_on, "cells": cells}, lambda _: ())

    def planned(self) -> list[Footage]:
        """Return each size and rate once, of the drive that has most frames of it."""
        best: dict[tuple[tuple[int, int], float], Footage] = {}
        for footage in self._possible():
            other = best.get((footage.size_px, footage.hz))
            if other is None or footage.frames > other.frames:
                best[footage.size_px, footage.hz] = footage
        return sorted(best.values(), key=lambda f: (f.size_px, f.hz))

    def _names(self) -> list[DriveName]:
        return [DriveName.parse(text) for text in self.drives]

    def _possible(self) -> Iterator[Footage]:
        sizes_px = [parse_size(size) for size in self.sizes]
        for drive in self._names():
            pictures = read_dataset(drive.dataset).pictures
            own = pictures[0].camera.intrinsics
            count = MIN_FRAMES if self.quick else len(pictures)
            for size_px in sizes_px:
                if size_px > (own.width_px, own.height_px):
                    continue
                for step in STEPS[:1] if self.quick else STEPS:
                    frames = -(-count // step)
                    slow = drive.rate_hz / step <= SLOW_HZ
                    if frames >= (MIN_FRAMES if slow or self.quick else SETTLED_FRAMES):
                        yield Footage(drive, size_px, step, frames)
