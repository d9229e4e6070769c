"""Slice coders on the same tasks: bytes and errors for BD-rates, processor time taken in turns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from time import process_time_ns
from typing import Protocol

import numpy as np

from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.codec.h264.slices import encode_slice
from rfcore.codec.h264.splice import SpliceDecoder
from rfcore.codec.photometric import Photometric
from rfedge.experiments.clips import luma_mse, psnr_of_mse
from rfedge.experiments.rate_curve import RateCurve, bd_rate_percent
from rfedge.experiments.slice_coder.report import BdRow, TimeRow
from rfedge.experiments.slice_coder.tasks import Footage, SliceTask, header_of, slice_tasks

__all__ = ["CRFS", "RIVALS", "bd_rows", "time_rows"]

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
