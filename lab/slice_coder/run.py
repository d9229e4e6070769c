"""The slice coder experiment from its inputs to its result file.

Slice coders do the same tasks: bytes and errors for BD-rates, processor time taken in turns.

The work that slice coders are compared on: frames, each with the references of a real stream.

The stream is coded by x264 medium in a closed loop, references chosen as the sender chooses them.
Every other coder gets the same pictures, so the curves differ by the coders alone; what a coder's
own reconstructions would be worth as references is not part of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter_ns, process_time_ns
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.slice_coder.report import BdRow, TimeRow, print_slice_coder
from rfcore.camera import Camera
from rfcore.codec.h264.bitstream import BitReader, rbsp_of_nal
from rfcore.codec.h264.config import CodecConfig, effort_of_preset
from rfcore.codec.h264.header import StreamHeader, check_header
from rfcore.codec.h264.parameter_sets import NAL_IDR, nal_type, parse_pps
from rfcore.codec.h264.slice_coder import Effort, SliceCoder
from rfcore.codec.h264.slices import CodedSlice, SliceCoding, encode_slice
from rfcore.codec.h264.splice import SpliceDecoder, grey
from rfcore.codec.photometric import Photometric
from rfcore.codec.prediction import Prediction
from rfcore.codec.sender.frame_costs import FrameCosts
from rfcore.codec.sender.reference_choice import choose_photometric, choose_references
from rfcore.codec.state import Past
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.field import RadianceField, render_field_view
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.evaluate.clips import Drive, DriveOfField, luma_mse, psnr_of_mse
from rfedge.evaluate.rate_curve import RateCurve, bd_rate_percent
from rfedge.results import check_result_path, make_result, provenance, write_result

__all__ = [
    "CRFS",
    "RIVALS",
    "Footage",
    "SliceCoderJob",
    "SliceTask",
    "bd_rows",
    "header_of",
    "resized",
    "run_slice_coder",
    "slice_qp",
    "slice_tasks",
    "time_rows",
]

with needs("eval"):
    import cv2

CRFS = (17.0, 20.0, 23.0, 26.0, 29.0, 32.0)
RIVALS = ("medium", "veryfast")
"""x264's presets; the first makes the references and is timed."""
QP_ABOVE = 1
"""Our quantiser above x264's: the same bytes and quality within 3 %. References differ from point
to point, so a coder with finer points would predict from worse pictures at the same quality."""
REPEATS = 3
QUICK_FRAMES = 4
TIMED_FRAMES = 6
_END_OF_CHANGES = 3
"""Of modification_of_pic_nums_idc (table 7-7)."""


@dataclass(frozen=True)
class Footage:
    """Frames of one size and what the field shows at the pose of each."""

    frames: Sequence[I420]
    views: Sequence[FieldView]

    @staticmethod
    def of(drive: Drive, field: RadianceField) -> Footage:
        """Render the field along a drive."""
        views = [render_field_view(field, camera) for camera in drive.cameras]
        return Footage(drive.frames, views)

    @property
    def config(self) -> CodecConfig:
        """The stream's configuration but for its quality."""
        return CodecConfig(*self.frames[0].size_px, effort=effort_of_preset(RIVALS[0]))


@dataclass(frozen=True)
class SliceTask:
    """One frame to code, the last reference being reference 0.

    ``crf`` is x264's, ``qp`` the quantiser its slice got there: coders without that rate control
    take it, so that the points of all are at nearly the same quality.
    """

    crf: float
    qp: int
    frame: I420
    references: tuple[I420, ...]


def header_of(config: CodecConfig) -> StreamHeader:
    """Return the parameter sets of a stream, the same for every coder."""
    return encode_slice(config, [grey(config)], grey(config)).header


def resized(drive: Drive, field: RadianceField, width_px: int, height_px: int) -> Footage:
    """Resample a drive's frames and render the field at that size."""
    cameras = [
        Camera(camera.intrinsics.resized(width_px, height_px), camera.world_from_cam)
        for camera in drive.cameras
    ]
    frames = [_resampled(frame, width_px, height_px) for frame in drive.frames]
    return Footage(frames, [render_field_view(field, camera) for camera in cameras])


def _resampled(frame: I420, width_px: int, height_px: int) -> I420:
    half = ((width_px + 1) // 2, (height_px + 1) // 2)
    sizes = ((width_px, height_px), half, half)
    planes = zip(frame.planes, sizes, strict=True)
    return I420(*(_resampled_plane(plane, size) for plane, size in planes))


def _resampled_plane(plane: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(plane, size_px, interpolation=cv2.INTER_CUBIC), np.uint8)


def slice_tasks(footage: Footage, crf: float, lights: list[Photometric]) -> Iterator[SliceTask]:
    """Yield every frame but the first with its references at ``crf``.

    ``lights`` holds each frame's light once it was looked for; an empty list is filled.
    """
    config = footage.config
    decoder = SpliceDecoder(header_of(config))
    past: Past | None = None
    for index, (frame, view) in enumerate(zip(footage.frames, footage.views, strict=True)):
        costs = FrameCosts(frame)
        if len(lights) <= index:
            lights.append(choose_photometric(costs, view.render, crf))
        prediction = Prediction.under_light(view, lights[index], past)
        references = choose_references(costs, prediction, crf)
        pictures = prediction.pictures(references)
        coded = encode_slice(_at(config, crf), pictures, frame)
        if index:
            yield SliceTask(crf, slice_qp(coded), frame, pictures)
        decoder.predict_from(*pictures)
        past = prediction.past_of(decoder.decode(coded.payload))


def slice_qp(coded: CodedSlice) -> int:
    """Return SliceQP_Y from a slice header of our streams (7.3.3), weights and list changes read
    over."""
    sps, pps = check_header(coded.header), parse_pps(coded.header.pps)
    r = BitReader(rbsp_of_nal(coded.payload))
    intra = nal_type(coded.payload) == NAL_IDR
    r.ue(), r.ue(), r.ue(), r.u(sps.log2_max_frame_num)
    if intra:
        r.ue(), r.u(2)  # idr_pic_id, dec_ref_pic_marking
    else:
        count = r.ue() + 1 if r.flag() else pps.default_refs[0]
        if r.flag():  # ref_pic_list_modification_flag_l0
            while r.ue() != _END_OF_CHANGES:
                r.ue()
        if pps.weighted_pred:
            _skip_weights(r, count)
        r.u(1)  # adaptive_ref_pic_marking_mode_flag
        r.ue()  # cabac_init_idc
    return pps.init_qp + r.se()


def _skip_weights(r: BitReader, count: int) -> None:
    r.ue(), r.ue()
    for _ in range(count):
        for values in (2, 4):
            for _ in range(values if r.flag() else 0):
                r.se()


def _at(config: CodecConfig, crf: float) -> CodecConfig:
    return CodecConfig(config.width_px, config.height_px, config.effort, crf)


class TaskCoder(Protocol):
    """Codes a task as one slice NAL unit without start code."""

    def __call__(self, task: SliceTask) -> bytes: ...


def _coders(config: CodecConfig, threads: int = 1) -> Mapping[str, TaskCoder]:
    """Return x264 at the presets of ``RIVALS`` and our coder at every effort, by name."""
    own = SliceCoder(header_of(config), threads=threads)

    def x264(preset: str) -> TaskCoder:
        at_preset = replace(config, effort=effort_of_preset(preset))

        def code(task: SliceTask) -> bytes:
            coding = SliceCoding(crf=task.crf, threads=threads)
            return encode_slice(at_preset, task.references, task.frame, coding).payload

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


@dataclass(frozen=True)
class Times:
    """What one slice took: of the processor, all threads together, and of the clock."""

    processor_ms: float
    wall_ms: float


def time_rows(footage: Footage, threads: int = 1) -> list[TimeRow]:
    """Return a row per effort over the tasks of most references, the coders taking turns.

    All coders run on so many threads.
    """
    coders = _coders(footage.config, threads)
    names = [RIVALS[0], *(effort.name.lower() for effort in Effort)]
    spent: dict[str, list[Times]] = {name: [] for name in names}
    lights: list[Photometric] = []
    most = 0
    for crf in CRFS:
        tasks = list(slice_tasks(footage, crf, lights))
        most = max(most, *(len(task.references) for task in tasks))
        for task in (task for task in tasks if len(task.references) == most):
            for name in names:
                spent[name].append(_least_times(coders[name], task))
    means = {name: _mean_times(found) for name, found in spent.items()}
    rival = means[RIVALS[0]]
    width, height = footage.config.size_px
    return [
        TimeRow(
            width, height, most, threads, name,
            means[name].processor_ms, rival.processor_ms, means[name].wall_ms, rival.wall_ms,
        )
        for name in names[1:]
    ]  # fmt: skip


def _mean_times(found: Sequence[Times]) -> Times:
    processor_ms, wall_ms = np.mean([(t.processor_ms, t.wall_ms) for t in found], axis=0)
    return Times(float(processor_ms), float(wall_ms))


def _least_times(code: TaskCoder, task: SliceTask) -> Times:
    """Return the least of either time over a few repetitions."""
    found = [_times(code, task) for _ in range(REPEATS)]
    return Times(min(t.processor_ms for t in found), min(t.wall_ms for t in found))


def _times(code: TaskCoder, task: SliceTask) -> Times:
    began_ns, processor_ns = perf_counter_ns(), process_time_ns()
    code(task)
    spent_ns = process_time_ns() - processor_ns
    return Times(spent_ns / 1e6, (perf_counter_ns() - began_ns) / 1e6)


@dataclass(frozen=True)
class SliceCoderJob:
    """What to run; see ``rfedge-lab slice-coder --help``."""

    field: Path
    drives: Sequence[str]
    timed: str
    sizes: Sequence[str]
    out: Path
    threads: Sequence[int] = (1,)
    quick: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        if not self.drives:
            raise InvalidInput("drives", "there is none")
        for number in self.threads:
            if number < 1:
                raise InvalidInput("threads", f"{number} is less than 1")

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
    drives = [DriveOfField.parse(text, job.field) for text in job.drives]
    sizes_px, timed = job.sizes_px, DriveOfField.parse(job.timed, job.field)
    made = provenance(sorted({drive.field for drive in (*drives, timed)}))
    limit = QUICK_FRAMES if job.quick else None
    rows: list[BdRow] = []
    for drive in drives:
        rows += bd_rows(drive.name.scene, drive.name.rate_hz, Footage.of(*drive.read(limit)))
        console.print(f"{drive.name.scene}: done")
    times = _time_rows(timed, sizes_px, job.threads)
    result = make_result("slice-coder", made, {"quick": job.quick, "rows": rows, "times": times})
    write_result(job.out, result)
    print_slice_coder(console, rows, times)
    return result


def _time_rows(
    drive: DriveOfField, sizes_px: Sequence[tuple[int, int]], threads: Sequence[int]
) -> list[TimeRow]:
    if not sizes_px:
        return []
    given, field = drive.read(TIMED_FRAMES)
    sized = [resized(given, field, *size) for size in sizes_px]
    return [row for footage in sized for number in threads for row in time_rows(footage, number)]
