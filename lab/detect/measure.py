"""Measure what a detector sees in decoded pictures: ours, ours with masks, and x264's.

The truth is what the detector itself sees in the camera's pictures (*itself*), surer than
``SURE``; and, where class pictures lie beside a drive, the boxes of connected vehicles and of
people in them (*street*). Neighbours that touch in the picture are one box there.

A mask gives the macroblocks of objects a finer quantiser (``rfcore.codec.h264.qp_map``). The
vehicle makes it of its own picture: where the detector sees something (*detector*, and for
``HELD_FRAMES`` after it was last seen there), where the picture differs from the field's render
(*unexplained*), or where both say so (*both*).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import process_time_ns
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.detect import EvalDetect
from lab.detect.detector import Box, Detector, DetectorFailed, as_text, of_text
from lab.detect.precision import (
    ALL,
    REPETITIONS,
    SIZES,
    Measured,
    Precision,
    counted_classes,
    drawn_curves,
    interval,
    precision_curve,
    shared_window,
)
from lab.report import Report, bars
from rfcore.codec.h264.qp_map import QpMap, qp_map_of_mask
from rfcore.errors import DatasetError, InvalidInput
from rfcore.image import I420
from rfcore.native.yuv import rgb_from_i420
from rfedge.evaluate.clips import QUICK, Clip, CodedClip, Drive, DriveOfField, Notes
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip, render_clip
from rfedge.evaluate.noted_coder import NotedCoder, PictureCoder
from rfedge.evaluate.performance import perform, seconds_left
from rfedge.evaluate.rate_curve import bd_rate_percent, drawn_blocks
from rfedge.evaluate.rivals import x264_lowdelay, x264_with_our_tools
from rfedge.evaluate.runner import Run, program_version
from rfedge.report.tables import Table, columns, shown
from rfedge.results import Result, rows_of
from streetgen.classes import Label, class_picture_of, read_classes

OURS = "rfedge"
MASKS = ("detector", "unexplained", "both")
STREET_CLASSES = (
    *("person", "bicycle", "car", "motorcycle"),
    *("bus", "truck", "trafficlight", "stopsign"),
)
"""Classes that are counted."""
GENERATED = {Label.VEHICLE: "vehicle", Label.PERSON: "person"}
AS_GENERATED = {"car": "vehicle", "bus": "vehicle", "truck": "vehicle", "person": "person"}
SURE = 0.4
"""Score from which a box on the camera's picture is the truth, and makes a mask."""
GROWN_PX, HELD_FRAMES = 8, 2
DIFFERENT_LEVELS = 12
LEAST_PX = 8
"""Side of the smallest box of a class picture."""
WINDOW_DB = 3.0
SEED = 2026
Frames = list[list[Box]]


class DetectedBoxes:
    """Notes of what a detector sees in each decoded picture; ``failed`` counts where it failed."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.version = detector.version
        self.failed = 0

    def of_run(self, run: slice) -> DetectedBoxes:
        """Return itself, which knows no frames."""
        del run
        return self

    def of(self, decoded: Sequence[I420], frames: Sequence[I420]) -> Mapping[str, Notes]:
        """Return the boxes as text, `null` where the detector failed."""
        del frames
        return {"boxes": tuple(as_text(self.boxes(picture)) for picture in decoded)}

    def boxes(self, picture: I420) -> list[Box] | None:
        """Return what the detector sees; None, and counted, where it fails."""
        try:
            return self._detector.boxes(rgb_from_i420(picture))
        except DetectorFailed:
            self.failed += 1
            return None


def object_masks(
    seen: Sequence[Sequence[Box] | None], rendered: RenderedClip, frames: Sequence[I420]
) -> dict[str, list[NDArray[np.bool_]]]:
    """Return for each of ``MASKS`` a mask bool [H, W] a frame. A frame in which the detector failed
    has the boxes of those before."""
    masks: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in MASKS}
    for k, (frame, view) in enumerate(zip(frames, rendered.views, strict=True)):
        boxed = np.zeros(frame.y.shape, bool)
        for boxes in seen[max(0, k - HELD_FRAMES) : k + 1]:
            for b in boxes or ():
                top, left = max(0, int(b.top) - GROWN_PX), max(0, int(b.left) - GROWN_PX)
                bottom, right = (int(v) + GROWN_PX for v in (b.top + b.height, b.left + b.width))
                boxed[top:bottom, left:right] |= b.score >= SURE
        difference = frame.y.astype(np.float32) - view.render.y
        unexplained = np.abs(cv2.blur(difference, (5, 5))) > DIFFERENT_LEVELS
        for name, mask in zip(MASKS, (boxed, unexplained, boxed & unexplained), strict=True):
            masks[name].append(mask)
    return masks


def generated_boxes(given: DriveOfField, drive: Drive) -> Frames | None:
    """Return what class pictures show of each frame; None where there are none."""
    folder = given.name.dataset
    folder = folder if folder.is_dir() else folder.parent
    found = []
    for picture in drive.pictures:
        try:
            path = class_picture_of(folder / picture.name)
        except DatasetError:
            return None
        if not path.is_file():
            return None
        found.append(list(_boxes_of_labels(read_classes(path))))
    return found


def _boxes_of_labels(labels: NDArray[np.uint8]) -> Iterator[Box]:
    for label, name in GENERATED.items():
        _, _, parts, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
        for left, top, width, height, _ in parts[1:].tolist():
            if min(width, height) >= LEAST_PX:
                yield Box(left, top, width, height, name)


@dataclass(frozen=True)
class DetectRow:
    """Average precision of one class and size in the pictures of one method, at the bits that
    ours needs for ``at_db``."""

    drive: str = field(metadata=shown("drive"))
    method: str = field(metadata=shown("method"))
    truth: str = field(metadata=shown("truth"))
    """``itself``, or ``street``."""
    class_: str = field(metadata=shown("class"))
    """``class`` in the file; ``all`` is the mean over classes."""
    size: str = field(metadata=shown("size"))
    boxes: int = field(metadata=shown("true boxes", "d"))
    map: float = field(metadata=shown("mAP %", ".1f"))
    psnr_db: float = field(metadata=shown("PSNR dB", ".2f"))
    bytes_per_frame: float = field(metadata=shown("bytes a frame", ".0f"))


@dataclass(frozen=True)
class DetectBdRow:
    """One method against another over what their curves of average precision share."""

    drive: str = field(metadata=shown("drive"))
    truth: str = field(metadata=shown("truth"))
    method: str = field(metadata=shown("method"))
    rival: str = field(metadata=shown("against"))
    window_map: Sequence[float] | None = field(metadata=shown("window mAP %", "{:.1f}..{:.1f}"))
    bd_rate_percent: float | None = field(metadata=shown("BD-rate %", "+.1f"))
    """None, as the window, where they share less than five percent."""
    ci95: Sequence[float] | None = field(metadata=shown("95 %", "{:.1f}..{:.1f}", "n/a"))


@dataclass(frozen=True)
class CostRow:
    """Time that the detector and the masks take on one drive."""

    drive: str = field(metadata=shown("drive"))
    frames: int = field(metadata=shown("frames", "d"))
    failed: int = field(metadata=shown("pictures it failed on", "d"))
    detector_ms: float = field(metadata=shown("detector ms a picture", ".0f"))
    mask_ms: float = field(metadata=shown("masks ms a picture", ".1f"))


@dataclass(frozen=True)
class DetectCurveRow:
    """The average precision of one method over its rates."""

    drive: str
    truth: str
    method: str
    point: Sequence[float]
    psnr_db: Sequence[float]
    bytes_per_frame: Sequence[float]
    map: Sequence[float]


@dataclass(frozen=True)
class DriveDetection:
    """One drive with every coder of it, and what is true in its frames."""

    name: str
    clip: Clip
    coders: Mapping[str, NotedCoder]
    truths: Mapping[str, Frames]
    failed: Sequence[int]
    """Frames that the detector failed on in the camera's pictures: they are left out."""
    cost: CostRow

    @property
    def counted(self) -> list[int]:
        """Places of the frames that count among those of a coded clip."""
        frames = [k for place, k in enumerate(self.clip.coded) if place and k not in self.failed]
        return [self.clip.coded.index(k) for k in frames]


def read_detection(job: EvalDetect, given: DriveOfField, noted: DetectedBoxes) -> DriveDetection:
    """Read a drive, let the detector see the camera's pictures, and make the masks."""
    drive, radiance = given.read(QUICK if job.quick else None)
    frames = drive.frames
    began_ns = process_time_ns()
    seen = [noted.boxes(frame) for frame in frames]
    detector_ms = (process_time_ns() - began_ns) / 1e6 / len(frames)
    rendered = render_clip(radiance, drive.cameras)
    began_ns = process_time_ns()
    masks = object_masks(seen, rendered, frames)
    mask_ms = (process_time_ns() - began_ns) / 1e6 / len(frames)

    def ours(name: str, qp_maps: Sequence[QpMap] = ()) -> FieldCoder:
        return FieldCoder(
            rendered,
            f"{name}-{job.effort}-{radiance.field_id[:12]}",
            program_version("lab/detect"),
            effort=job.effort,
            qp_maps=qp_maps,
        )

    coders: dict[str, PictureCoder] = {OURS: ours(OURS)}
    for name, those in masks.items():
        maps = [qp_map_of_mask(mask, frames[0].size_px, job.mask_qp) for mask in those]
        coders[f"{OURS}-{name}"] = ours(f"{OURS}-{name}", maps)
    rivals = (x264_with_our_tools(job.preset), x264_lowdelay(job.preset))
    coders |= {rival.name: rival for rival in rivals}
    truths = {"itself": [[b for b in boxes or () if b.score >= SURE] for boxes in seen]}
    street = generated_boxes(given, drive)
    if street is not None:
        truths["street"] = street
    failed = [k for k, boxes in enumerate(seen) if boxes is None]
    name = f"{given.name.scene}@{given.name.rate_hz:g}"
    return DriveDetection(
        name,
        drive.clip(),
        {name: NotedCoder(coder, noted) for name, coder in coders.items()},
        truths,
        failed,
        CostRow(name, len(frames), len(failed), detector_ms, mask_ms),
    )


@dataclass(frozen=True)
class MethodCurve:
    """One method's clips of a drive, from the fewest bytes, each with its average precision."""

    method: str
    clips: Sequence[CodedClip]
    precisions: Sequence[Precision]

    def at(self, bytes_per_frame: float) -> tuple[float, dict[tuple[str, str], float]]:
        """Return PSNR and average precisions at a rate, on straight lines over its logarithm; at
        the end of the curve where it does not reach that far."""
        logs = np.log([clip.bytes_per_frame() for clip in self.clips])
        at = np.log(bytes_per_frame)
        known = [precision.percent() for precision in self.precisions]
        psnr_db = float(np.interp(at, logs, [clip.psnr_db() for clip in self.clips]))
        keys = [key for key in known[0] if all(key in each for each in known)]
        found = {key: float(np.interp(at, logs, [each[key] for each in known])) for key in keys}
        return psnr_db, found


def method_curves(
    detection: DriveDetection, truth: str, clips: Mapping[str, Sequence[CodedClip]]
) -> list[MethodCurve]:
    """Match what was seen in each clip with a truth; empty where the truth has too few boxes."""
    places = detection.counted
    true = [detection.truths[truth][detection.clip.coded[place]] for place in places]
    names = STREET_CLASSES if truth == "itself" else list(GENERATED.values())
    classes = [name for name in counted_classes(true) if name in names]
    if not classes:
        return []
    curves = []
    for method, coded in clips.items():
        ordered = sorted(coded, key=CodedClip.bytes_per_frame)
        precisions = []
        for clip in ordered:
            found = [of_text(str(clip.notes["boxes"][place])) or [] for place in places]
            if truth == "street":
                found = [[_as_generated(b) for b in boxes] for boxes in found]
            precisions.append(Precision(true, found, classes))
        curves.append(MethodCurve(method, ordered, precisions))
    return curves


def _as_generated(box: Box) -> Box:
    return replace(box, class_=AS_GENERATED.get(box.class_, box.class_))


def equal_bits_rows(
    detection: DriveDetection, truth: str, curves: Sequence[MethodCurve], at_db: float
) -> Iterator[DetectRow]:
    """Yield every method's average precisions at the bits that the first needs for a quality."""
    ours = curves[0]
    qualities = [clip.psnr_db() for clip in ours.clips]
    logs = np.log([clip.bytes_per_frame() for clip in ours.clips])
    if not qualities[0] <= at_db <= qualities[-1]:
        raise InvalidInput(
            "at_db",
            f"{at_db:g} dB is not within the {qualities[0]:.2f}..{qualities[-1]:.2f} dB of ours on "
            f"{detection.name}; choose another --at-db",
        )
    rate = float(np.exp(np.interp(at_db, qualities, logs)))
    frames = [detection.clip.coded[place] for place in detection.counted]
    true = [box for k in frames for box in detection.truths[truth][k]]
    for curve in curves:
        psnr_db, found = curve.at(rate)
        for (class_, size), value in found.items():
            boxes = sum(class_ in (ALL, b.class_) and size in (ALL, _size(b)) for b in true)
            yield DetectRow(
                detection.name, curve.method, truth, class_, size, boxes, value, psnr_db, rate
            )


def _size(box: Box) -> str:
    area = box.width * box.height
    return SIZES[1 + (area >= 32**2) + (area >= 96**2)]


def bd_rows(
    detection: DriveDetection, truth: str, curves: Sequence[MethodCurve], *, quick: bool
) -> Iterator[DetectBdRow]:
    """Yield every one of ours against each rival, and those with masks against ours without."""
    by_name = {curve.method: curve for curve in curves}
    rivals = [name for name in by_name if not name.startswith(OURS)]
    pairs = [(m, r) for m in by_name if m.startswith(OURS) for r in rivals]
    pairs += [(m, OURS) for m in by_name if m.startswith(f"{OURS}-")]
    count = len(detection.counted)
    rng = np.random.default_rng(SEED)
    draws = [] if quick else [drawn_blocks(0, count, rng) for _ in range(REPETITIONS)]
    drawn = {name: drawn_curves(_points(each, detection), draws) for name, each in by_name.items()}
    for method, rival in pairs:
        ours, theirs = by_name[method], by_name[rival]
        whole = [
            precision_curve(
                [p.percent()[ALL, ALL] for p in curve.precisions],
                [clip.bytes_per_frame() for clip in curve.clips],
            )
            for curve in (theirs, ours)
        ]
        window = shared_window(whole)
        bd_rate = None if window is None else bd_rate_percent(whole[0], whole[1], window)
        ci95 = None if quick or window is None else interval(drawn[method], drawn[rival])
        yield DetectBdRow(detection.name, truth, method, rival, window, bd_rate, ci95)


def _points(curve: MethodCurve, detection: DriveDetection) -> list[Measured]:
    places = detection.counted
    sizes = [clip.frame_bytes[places] for clip in curve.clips]
    return list(zip(curve.precisions, sizes, strict=True))


def run_detect(job: EvalDetect, console: Console) -> dict[str, Any]:
    """Code and look at what is not there yet, write the result and print its rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    detector = Detector(job.detector, job.adapter)
    noted = DetectedBoxes(detector)
    given = [DriveOfField.parse(text, job.field) for text in job.drives]
    fields = dict.fromkeys([job.detector, *(each.field for each in given)])
    run = Run.begin("detect", job, fields, console)
    if detector.licence is None:
        run.tell(
            f"no licence (LICENSE, LICENCE or COPYING) lies beside {job.detector}: see whether you "
            "may use it"
        )
    window = (job.at_db - WINDOW_DB / 2, job.at_db + WINDOW_DB / 2)
    result: dict[str, list[Any]] = {"rows": [], "bd_rates": [], "cost": [], "curves": []}
    frames = {}
    for each in given:
        detection = read_detection(job, each, noted)
        clip, coders = detection.clip, detection.coders
        left_s = seconds_left(clip, coders.values(), run.store)
        run.tell(f"{detection.name}: about {left_s / 60:.1f} minutes left to do")
        clips = {
            name: perform(clip, coder, run.store, window_db=window, timed=False).clips
            for name, coder in coders.items()
        }
        frames[detection.name] = clip.frames_digest
        result["cost"].append(replace(detection.cost, failed=_failed(clips, detection)))
        for truth in detection.truths:
            curves = method_curves(detection, truth, clips)
            if not curves:
                run.tell(f"{detection.name}: too few boxes to count in truth {truth!r}")
                continue
            result["rows"] += [
                _row(row) for row in equal_bits_rows(detection, truth, curves, job.at_db)
            ]
            result["bd_rates"] += bd_rows(detection, truth, curves, quick=job.quick)
            result["curves"] += [_curve_row(detection.name, truth, curve) for curve in curves]
    content = {"frames": frames, "detector": detector.version, "mask_qp": job.mask_qp, **result}
    return run.finish(content, detect_parts)


def _failed(clips: Mapping[str, Sequence[CodedClip]], detection: DriveDetection) -> int:
    notes = (note for coded in clips.values() for clip in coded for note in clip.notes["boxes"])
    return len(detection.failed) + sum(note == "null" for note in notes)


def _row(row: DetectRow) -> dict[str, Any]:
    return {name.rstrip("_"): value for name, value in vars(row).items()}


def _rows(result: Result) -> list[DetectRow]:
    named = ({**row, "class_": row["class"]} for row in result["rows"])
    return rows_of(DetectRow, [{k: v for k, v in row.items() if k != "class"} for row in named])


def _curve_row(drive: str, truth: str, curve: MethodCurve) -> DetectCurveRow:
    return DetectCurveRow(
        drive,
        truth,
        curve.method,
        [clip.point for clip in curve.clips],
        [clip.psnr_db() for clip in curve.clips],
        [clip.bytes_per_frame() for clip in curve.clips],
        [precision.percent()[ALL, ALL] for precision in curve.precisions],
    )


def detect_parts(result: Result) -> Iterator[Table | str]:
    """Yield BD-rates, then average precisions at equal bits, of all and by class and size."""
    yield Table(
        "BD-rate over average precision",
        columns(DetectBdRow),
        rows_of(DetectBdRow, result["bd_rates"]),
    )
    rows = _rows(result)
    whole = [row for row in rows if row.class_ == row.size == ALL]
    known = ("drive", "method", "truth", "boxes", "map", "psnr_db", "bytes_per_frame")
    yield Table("At equal bits", columns(DetectRow, *known), whole)
    parts = [row for row in rows if row not in whole and ALL in (row.class_, row.size)]
    by_part = ("drive", "method", "truth", "class_", "size", "boxes", "map")
    yield Table("At equal bits, by class and by size", columns(DetectRow, *by_part), parts)
    yield Table("What it costs", columns(CostRow), rows_of(CostRow, result["cost"]))
    yield (
        f"{result['detector']}. *itself*: against its own boxes on the camera's pictures (score "
        f"{SURE:g} and more); *street*: against what the generator drew. Average precision by "
        f"COCO's rules, over classes of ten boxes and more. Masks: {result['mask_qp']} QP where "
        "the detector sees an object, where the field does not explain the picture, or both."
    )


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in _rows(result):
        if row.class_ == row.size == ALL and row.truth == "itself":
            yield f"{row.drive}: {row.method}", row.map


REPORT = Report(
    "detect",
    "What a detector sees",
    "How well an object detector sees vehicles and people in the pictures that arrive, at the same "
    "bits, by our coder and by x264.",
    detect_parts,
    bars("mAP at equal bits, %", _bars),
)
