"""Measure quality by class: how vehicles, people, signs and markings look at equal averages.

A frame's PSNR is an average in which the road, the sky and the facades outweigh what a twin is for.
Here the squared error of the luma is summed over the pixels of each class, over all frames but the
first. Between operating points log(MSE) is interpolated over log(bytes a frame) by a monotone cubic
(PCHIP), at two rates: at *equal bits*, those that ours needs for a quality of the whole picture,
and at *equal quality*, those that each coder needs for it itself.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.classes import EvalClasses
from lab.report import Report, bars
from rfcore.errors import InvalidInput
from rfcore.extras import needs
from rfcore.image import I420
from rfcore.metrics import psnr_of_mse
from rfedge.evaluate.clips import (
    QUICK,
    STEADY,
    Clip,
    CodedClip,
    Drive,
    DriveName,
    DriveOfField,
    Notes,
)
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.noted_coder import NotedCoder, PictureCoder
from rfedge.evaluate.performance import perform, seconds_left
from rfedge.evaluate.rivals import x264_lowdelay, x264_with_our_tools
from rfedge.evaluate.runner import Run, coded_clip, program_version
from rfedge.jobs import CellStore
from rfedge.report.tables import Table, text_table
from rfedge.results import Result, rows_of
from streetgen.classes import Label, class_picture_of, read_classes

with needs("eval"):
    from scipy.interpolate import PchipInterpolator

GROUPS = ("rest", "vehicle", "person", "sign", "marking")
ALL = "all"
"""The class of the whole picture."""
GROUP_OF = {
    Label.VEHICLE: "vehicle",
    Label.PERSON: "person",
    Label.BICYCLE: "person",
    Label.SIGN: "sign",
    Label.MARKING: "marking",
}
"""A cyclist's bicycle counts with the person; all other labels are the rest."""
LEVELS = np.array([GROUPS.index(GROUP_OF.get(label, "rest")) for label in Label], np.uint8)
OURS = "rfedge"
EQUAL_BITS, EQUAL_QUALITY = "bits", "quality"
ROUNDING = 1e-9
"""Share by which an interpolated rate may miss the end of its curve."""
Groups = Sequence[NDArray[np.uint8]]
"""Indices into ``GROUPS`` uint8 [H, W], one array a frame."""
F64 = NDArray[np.float64]


def read_groups(name: DriveName, drive: Drive) -> list[NDArray[np.uint8]]:
    """Return the groups of every frame of a drive, from the class pictures beside its pictures.

    Raises ``DatasetError`` where one is missing or no class picture, ``InvalidInput`` for one of
    another size than its frame.
    """
    folder = name.dataset if name.dataset.is_dir() else name.dataset.parent
    found = []
    for picture, frame in zip(drive.pictures, drive.frames, strict=True):
        path = class_picture_of(folder / picture.name)
        labels = read_classes(path)
        if labels.shape != frame.y.shape:
            height, width = labels.shape
            raise InvalidInput("classes", f"{path}: {(width, height)} px, frame {frame.size_px} px")
        found.append(LEVELS[labels])
    return found


@dataclass(frozen=True)
class ClassErrors:
    """Notes of the luma's squared error of each group, for a ``NotedCoder``."""

    groups: Groups

    @property
    def version(self) -> str:
        """The digest of the groups."""
        digest = hashlib.sha256()
        for groups in self.groups:
            digest.update(groups.tobytes())
        return f"classes {digest.hexdigest()[:16]}"

    def of_run(self, run: slice) -> ClassErrors:
        """Return the notes of the frames ``run`` alone."""
        return ClassErrors(self.groups[run])

    def of(self, decoded: Sequence[I420], frames: Sequence[I420]) -> Mapping[str, Notes]:
        """Return the errors of each group; ``frames`` may be the beginning of those of the
        groups."""
        grouped = zip(decoded, frames, self.groups[: len(frames)], strict=True)
        errors = np.array([_group_sse(*each) for each in grouped])
        return {_note(name): tuple(errors[:, i].tolist()) for i, name in enumerate(GROUPS)}


def _note(group: str) -> str:
    return f"{group}_sse"


def _group_sse(decoded: I420, frame: I420, groups: NDArray[np.uint8]) -> F64:
    """Return the sum of squared luma errors over the pixels of each group."""
    difference = decoded.y.astype(np.float64) - frame.y
    squares = (difference * difference).ravel()
    sums = np.bincount(groups.ravel(), weights=squares, minlength=len(GROUPS))
    return np.asarray(sums, np.float64)


@dataclass(frozen=True)
class ClassQuality:
    """The luma PSNR of one class of one drive as one coder shows it."""

    scene: str
    hz: float
    method: str
    class_: str
    """One of ``GROUPS``, or ``all``; ``class`` in the file."""
    psnr_db: float
    share_percent: float
    """Share of the pixels of all frames but the first."""
    equal: str
    """The quantity that all coders share: ``bits``, or ``quality`` of the whole picture."""
    at_db: float
    """The quality of the comparison; for equal bits, that of our coder."""
    bytes_per_frame: float

    def row(self) -> dict[str, Any]:
        """Return it as the file has it."""
        return {f.name.rstrip("_"): getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def of_rows(rows: Iterable[Mapping[str, Any]]) -> list[ClassQuality]:
        """Read them back; raises ``InvalidInput`` for a row of other keys."""
        names = {field.name.rstrip("_"): field.name for field in fields(ClassQuality)}
        named = ({names.get(key, key): value for key, value in row.items()} for row in rows)
        return rows_of(ClassQuality, named)


@dataclass(frozen=True)
class ClassCurve:
    """One coder's clips of a drive, and how many pixels a frame each group has, [N, G]."""

    method: str
    clips: Sequence[CodedClip]
    pixels: F64

    def bytes_at(self, psnr_db: float) -> float:
        """Return the bytes a frame at a quality of the whole picture; raises as ``quality_at``."""
        qualities = np.array([clip.psnr_db() for clip in self.clips])
        self._check_within(psnr_db, qualities, "dB")
        return math.exp(_between(qualities, self._log_bytes, psnr_db))

    def mse_at(self, bytes_per_frame: float) -> dict[str, float]:
        """Return the mean squared error of each group that has pixels, and of all, at a rate."""
        self._check_within(bytes_per_frame, np.exp(self._log_bytes), "bytes a frame")
        steady = self.pixels[STEADY].sum(axis=0)
        errors = np.array([_steady_sse(clip) for clip in self.clips])
        columns = {name: errors[:, i] / steady[i] for i, name in enumerate(GROUPS) if steady[i]}
        columns[ALL] = errors.sum(axis=1) / steady.sum()
        at = math.log(bytes_per_frame)
        return {
            name: math.exp(_between(self._log_bytes, np.log(mse), at))
            for name, mse in columns.items()
        }

    @property
    def _log_bytes(self) -> F64:
        return np.log([clip.bytes_per_frame() for clip in self.clips])

    def _check_within(self, value: float, known: F64, unit: str) -> None:
        low, high = float(known.min()), float(known.max())
        if not low * (1 - ROUNDING) <= value <= high * (1 + ROUNDING):
            raise InvalidInput(
                "at_db",
                f"{self.method} has {low:.2f}..{high:.2f} {unit}, not {value:.2f}; choose another "
                "--at-db",
            )


def _between(x: F64, y: F64, at: float) -> float:
    """Interpolate y over x, of which equal values count once, with the least y."""
    order = np.lexsort((y, x))
    known, first = np.unique(x[order], return_index=True)
    return float(PchipInterpolator(known, y[order][first])(np.clip(at, known[0], known[-1])))


def _steady_sse(clip: CodedClip) -> F64:
    return np.array([sum(map(float, clip.notes[_note(name)][STEADY])) for name in GROUPS])


def quality_at(curves: Sequence[ClassCurve], clip: Clip, at_db: float) -> Iterator[ClassQuality]:
    """Yield every coder's classes at the bits that the first needs for a quality, and at that
    quality. Raises ``InvalidInput`` for what a curve does not reach."""
    same_bytes = curves[0].bytes_at(at_db)
    rates = [(EQUAL_BITS, curve, same_bytes) for curve in curves]
    rates += [(EQUAL_QUALITY, curve, curve.bytes_at(at_db)) for curve in curves]
    for equal, curve, rate in rates:
        shares = _shares(curve.pixels)
        for name, mse in curve.mse_at(rate).items():
            yield ClassQuality(
                scene=clip.scene,
                hz=clip.rate_hz,
                method=curve.method,
                class_=name,
                psnr_db=psnr_of_mse(mse),
                share_percent=shares[name],
                equal=equal,
                at_db=at_db,
                bytes_per_frame=rate,
            )


def _shares(pixels: F64) -> dict[str, float]:
    steady = pixels[STEADY].sum(axis=0)
    parts = 100 * steady / steady.sum()
    return {ALL: 100.0, **dict(zip(GROUPS, parts.tolist(), strict=True))}


@dataclass(frozen=True)
class ClassComparison:
    """One drive with ours and the rivals; the first coder is ours."""

    clip: Clip
    groups: Groups
    coders: Mapping[str, NotedCoder]

    def curves(self, store: CellStore, at_db: Sequence[float]) -> list[ClassCurve]:
        """Code what is not there yet, at points that span the qualities and the bits asked for."""
        groups = [self.groups[k] for k in self.clip.coded]
        pixels = np.array([np.bincount(g.ravel(), minlength=len(GROUPS)) for g in groups])
        window = min(at_db), max(at_db)
        made: list[ClassCurve] = []
        for name, coder in self.coders.items():
            done = perform(self.clip, coder, store, window_db=window, timed=False)
            clips: Sequence[CodedClip] = done.clips
            if made:
                fewest, most = (made[0].bytes_at(db) for db in window)
                clips = self._reaching(coder, store, clips, (fewest, most))
            made.append(ClassCurve(name, clips, pixels.astype(np.float64)))
        return made

    def _reaching(
        self,
        coder: NotedCoder,
        store: CellStore,
        clips: Sequence[CodedClip],
        wanted: tuple[float, float],
    ) -> list[CodedClip]:
        """Return the clips with more beyond either end until their bytes span those wanted, or
        the coder's points end."""
        best, worst = coder.limits
        found = sorted(clips, key=lambda coded: coded.point)
        step = found[-1].point - found[-2].point
        while found[-1].bytes_per_frame() > wanted[0] and found[-1].point < worst:
            point = min(found[-1].point + step, worst)
            found.append(coded_clip(self.clip, coder, point, store))
        while found[0].bytes_per_frame() < wanted[1] and found[0].point > best:
            point = max(found[0].point - step, best)
            found.insert(0, coded_clip(self.clip, coder, point, store))
        return found


def run_classes(job: EvalClasses, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write the result and print its rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong, and
    ``InvalidInput`` afterwards for qualities or bits that a coder does not reach.
    """
    drives = [DriveOfField.parse(text, job.field) for text in job.drives]
    run = Run.begin("classes", job, dict.fromkeys(d.field for d in drives), console)
    comparisons = [_comparison(job, drive) for drive in drives]
    left_s = sum(seconds_left(c.clip, c.coders.values(), run.store) for c in comparisons)
    run.tell(f"{len(comparisons)} drives, about {left_s / 60:.1f} minutes left to do")
    found: list[ClassQuality] = []
    for comparison in comparisons:
        curves = comparison.curves(run.store, job.at_db)
        found += chain.from_iterable(quality_at(curves, comparison.clip, db) for db in job.at_db)
    frames = {f"{c.clip.scene}@{c.clip.rate_hz:g}": c.clip.frames_digest for c in comparisons}
    return run.finish({"frames": frames, "rows": [each.row() for each in found]}, _parts)


def _comparison(job: EvalClasses, given: DriveOfField) -> ClassComparison:
    drive, field = given.read(QUICK if job.quick else None)
    groups = read_groups(given.name, drive)
    ours = FieldCoder(
        render_clip(field, drive.cameras),
        f"{OURS}-{job.effort}-{field.field_id[:12]}",
        program_version("lab/classes"),
        effort=job.effort,
    )
    rivals = (x264_with_our_tools(job.preset), x264_lowdelay(job.preset))
    coders: dict[str, PictureCoder] = {OURS: ours, **{rival.name: rival for rival in rivals}}
    return ClassComparison(
        drive.clip(),
        groups,
        {name: NotedCoder(coder, ClassErrors(groups)) for name, coder in coders.items()},
    )


SHOWN = (ALL, *GROUPS[1:], GROUPS[0])


def _parts(result: Result) -> Iterator[Table | str]:
    """Yield a table for each drive and quality, and for each drive the classes' shares."""
    tables: dict[str, dict[tuple[str, str], list[ClassQuality]]] = {}
    shares: dict[str, list[ClassQuality]] = {}
    for row in ClassQuality.of_rows(result["rows"]):
        drive = f"{row.scene}, {row.hz:g} Hz"
        lines = tables.setdefault(f"{drive}: PSNR of the luma, dB, at equal {row.equal}", {})
        lines.setdefault((row.method, f"{row.at_db:g} dB"), []).append(row)
        shares.setdefault(drive, []).append(row)
    for title, lines in tables.items():
        several = len({at_db for _, at_db in lines}) > 1
        cells = [
            [f"{method} at {at_db}" if several else method, *_line(rows)]
            for (method, at_db), rows in lines.items()
        ]
        yield text_table(("method", "bytes a frame", *SHOWN), cells, title)
    by_drive = [
        [drive, *_by_class(rows, lambda row: f"{row.share_percent:.1f}")]
        for drive, rows in shares.items()
    ]
    yield text_table(("drive", *SHOWN), by_drive, "Share of the pixels, %")


def _line(rows: Sequence[ClassQuality]) -> list[str]:
    quality = _by_class(rows, lambda row: f"{row.psnr_db:.2f}")
    return [f"{rows[0].bytes_per_frame:.0f}", *quality]


def _by_class(rows: Sequence[ClassQuality], text: Callable[[ClassQuality], str]) -> list[str]:
    found = {row.class_: text(row) for row in rows}
    return [found.get(name, "-") for name in SHOWN]


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in ClassQuality.of_rows(result["rows"]):
        if row.equal == EQUAL_BITS:
            yield f"{row.scene} {row.class_}: {row.method}", row.psnr_db


REPORT = Report(
    "classes",
    "Quality by class",
    "How well vehicles, people, signs and markings are seen at the same bits, and at the same "
    "quality of the whole picture, by our coder and by x264.",
    _parts,
    bars("luma PSNR at equal bits, dB", _bars),
)
