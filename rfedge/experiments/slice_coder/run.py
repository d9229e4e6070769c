"""The slice coder experiment from its inputs to its result file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from rfcore.errors import InvalidInput
from rfedge.experiments.clips import DriveOfField
from rfedge.experiments.slice_coder.measure import bd_rows, time_rows
from rfedge.experiments.slice_coder.report import BdRow, TimeRow, print_slice_coder
from rfedge.experiments.slice_coder.tasks import Footage, noisy, resized
from rfedge.results import check_result_path, make_result, provenance, write_result

__all__ = ["NOISE_SIGMA", "SliceCoderJob", "run_slice_coder"]

NOISE_SIGMA, NOISE_SEED = 3.0, 1
QUICK_FRAMES = 4
TIMED_FRAMES = 6


@dataclass(frozen=True)
class SliceCoderJob:
    """What to run; see ``rfedge eval slice-coder --help``."""

    field: Path
    drives: Sequence[str]
    noisy: Sequence[str]
    timed: str
    sizes: Sequence[str]
    out: Path
    quick: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not (self.drives or self.noisy):
            raise InvalidInput("drives", "there is none")

    @property
    def sizes_px(self) -> list[tuple[int, int]]:
        """The sizes to time at; raises ``InvalidInput`` for text of another form."""
        return [_size_px(text) for text in self.sizes]


def _size_px(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise InvalidInput("sizes", f"{text!r} is not WIDTHxHEIGHT, as 1280x720")
    return int(found[1]), int(found[2])


def run_slice_coder(job: SliceCoderJob, console: Console) -> dict[str, Any]:
    """Code everything, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    plain, noise = ([DriveOfField.parse(t, job.field) for t in d] for d in (job.drives, job.noisy))
    sizes_px, timed = job.sizes_px, DriveOfField.parse(job.timed, job.field)
    made = provenance(sorted({drive.field for drive in (*plain, *noise, timed)}))
    limit = QUICK_FRAMES if job.quick else None
    rows: list[BdRow] = []
    for drive in plain:
        rows += _bd_rows(drive, limit, sigma=0.0)
        console.print(f"{drive.name.scene}: done")
    for drive in noise:
        rows += _bd_rows(drive, limit, sigma=NOISE_SIGMA)
        console.print(f"{drive.name.scene} with noise: done")
    times = _time_rows(timed, sizes_px)
    result = make_result("slice-coder", made, {"quick": job.quick, "rows": rows, "times": times})
    write_result(job.out, result)
    print_slice_coder(console, rows, times)
    return result


def _bd_rows(drive: DriveOfField, limit: int | None, sigma: float) -> list[BdRow]:
    footage, name = Footage.of(*drive.read(limit)), drive.name
    if sigma:
        footage = noisy(footage, sigma, NOISE_SEED)
        name = replace(name, scene=f"{name.scene} noise {sigma:g}")
    return list(bd_rows(name.scene, name.rate_hz, footage))


def _time_rows(drive: DriveOfField, sizes_px: Sequence[tuple[int, int]]) -> list[TimeRow]:
    if not sizes_px:
        return []
    given, field = drive.read(TIMED_FRAMES)
    return [row for size in sizes_px for row in time_rows(resized(given, field, *size))]
