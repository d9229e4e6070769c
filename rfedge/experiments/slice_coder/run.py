"""The slice coder experiment from its inputs to its result file.

Slice coders do the same tasks: bytes and errors for BD-rates, processor time taken in turns.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time_ns
from typing import Any, Protocol

import numpy as np
from rich.console import Console

from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.codec.h264.slices import encode_slice
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.codec.photometric import Photometric
from rfcore.errors import InvalidInput
from rfedge.experiments.clips import DriveOfField, luma_mse, psnr_of_mse
from rfedge.experiments.rate_curve import RateCurve, bd_rate_percent
from rfedge.experiments.slice_coder.report import BdRow, TimeRow, print_slice_coder
from rfedge.experiments.slice_coder.tasks import (
    Footage,
    SliceTask,
    header_of,
    noisy,
    resized,
    slice_tasks,
)
from rfedge.results import check_result_path, make_result, provenance, write_result

__all__ = [
    "CRFS",
    "NOISE_SIGMA",
    "RIVALS",
    "SliceCoderJob",
    "bd_rows",
    "run_slice_coder",
    "time_rows",
]

CRFS = (17.0, 20.0, 23.0, 26.0, 29.0, 32.0)
RIVALS = ("medium", "veryfast")
"""x264's presets; the first makes the references and is timed."""
QP_ABOVE = 1
"""Our quantiser above x264's: the same bytes and quality within 3 %. References differ from point
to point, so a coder with finer points would predict from worse pictures at the same quality."""
REPEATS = 3
TIMED_FRAMES = 4


class TaskCoder(Protocol):
    """Codes a task as one slice NAL unit without start code."""

    def __call__(self, task: SliceTask) -> bytes: ...


def _coders(config: CodecConfig) -> Mapping[str, TaskCoder]:
    """Return x264 at the presets of ``RIVALS`` and our coder at every effort, by name."""
    own = SliceCoder(header_of(config))

    def x264(preset: str) -> TaskCoder:
        at_preset = replace(config, effort=effort_of_preset(preset))

        def code(task: SliceTask) -> bytes:
            return encode_slice(
                replace(at_preset, crf=task.crf), task.references, task.frame
            ).payload

        return code

    def ours(effort: Effort) -> TaskCoder:
        def code(task: SliceTask) -> bytes:
            return own.encode(
                task.frame, task.references, task.qp + QP_ABOVE, effort=effort
            ).payload

        return code

    rivals = {preset: x264(preset) for preset in RIVALS}
    return rivals | {effort.name.lower(): ours(effort) for effort in Effort}


def bd_rows(drive: str, hz: float, footage: Footage) -> Iterator[BdRow]:
    """Yield a row for every effort against every rival, of luma PSNR over whole curves.

    Raises ``InvalidInput`` where the curves of two coders have no quality in common.
    """
    curves = _curves(footage)
    width, height = footage.config.size_px
    for effort in Effort:
        name = effort.name.lower()
        for rival in RIVALS:
            percent = _bd_rate_percent(curves[rival], curves[name])
            yield BdRow(drive, hz, width, height, name, rival, percent)


def _bd_rate_percent(anchor: RateCurve, test: RateCurve) -> float:
    low = max(anchor.psnr_db[0], test.psnr_db[0])
    high = min(anchor.psnr_db[-1], test.psnr_db[-1])
    return bd_rate_percent(anchor, test, (float(low), float(high)))


def _curves(footage: Footage) -> Mapping[str, RateCurve]:
    """Code every task with every coder; a slice is as good as what the receiver makes of it."""
    coders, decoder = _coders(footage.config), SpliceDecoder(header_of(footage.config))
    points: dict[str, list[tuple[float, float]]] = {name: [] for name in coders}
    lights: list[Photometric] = []
    for crf in CRFS:
        sizes: dict[str, list[int]] = {name: [] for name in coders}
        errors: dict[str, list[float]] = {name: [] for name in coders}
        for task in slice_tasks(footage, crf, lights):
            for name, code in coders.items():
                payload = code(task)
                decoder.predict_from(*task.references)
                sizes[name].append(len(payload))
                errors[name].append(luma_mse(decoder.decode(payload), task.frame))
        for name in coders:
            quality_db = psnr_of_mse(float(np.mean(errors[name])))
            points[name].append((quality_db, float(np.mean(sizes[name]))))
    return {name: _curve(found) for name, found in points.items()}


def _curve(points: Sequence[tuple[float, float]]) -> RateCurve:
    qualities, sizes = np.array(sorted(points)).T
    return RateCurve(qualities, sizes)


def time_rows(footage: Footage, threads: int = 1) -> list[TimeRow]:
    """Return a row per effort over the tasks of three references, the coders taking turns."""
    coders = _coders(footage.config)
    names = [RIVALS[0], *(effort.name.lower() for effort in Effort)]
    spent: dict[str, list[float]] = {name: [] for name in names}
    lights: list[Photometric] = []
    most = 0
    for crf in CRFS:
        tasks = list(slice_tasks(footage, crf, lights))
        most = max(most, *(len(task.references) for task in tasks))
        for task in [task for task in tasks if len(task.references) == most][-TIMED_FRAMES:]:
            for name in names:
                spent[name].append(_least_ms(coders[name], task))
    means = {name: float(np.mean(found)) for name, found in spent.items()}
    width, height = footage.config.size_px
    return [
        TimeRow(width, height, most, threads, name, means[name], means[RIVALS[0]])
        for name in names[1:]
    ]


def _least_ms(code: TaskCoder, task: SliceTask) -> float:
    times = []
    for _ in range(REPEATS):
        began_ns = process_time_ns()
        code(task)
        times.append((process_time_ns() - began_ns) / 1e6)
    return min(times)


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
