"""The format of a submission to the benchmark, made by a command and checked against drives.

A submission is a folder::

    submission.json         who coded, with what, where; bytes of each frame at each point
    prior/FILE              what both ends hold before the first frame, if anything
    DRIVE/POINT/0000.packet what is sent for a frame
    DRIVE/POINT/0000.yuv    what a receiver shows for it, raw I420; or 0000.png, RGB

Nothing that a submission states is believed where it can be measured: quality is taken from the
decoded pictures, bytes from the packets. Whether a packet was made without later frames cannot be
seen in it; a result says so. Whether packets show the pictures is seen where the checker has a
decoder (``lab.benchmark.method``, which also makes submissions).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from lab.benchmark.definition import Benchmark, score_rows
from rfcore.errors import InvalidData, InvalidInput
from rfcore.image import I420, read_rgb
from rfcore.native.yuv import i420_from_rgb
from rfcore.tables import Range, Table
from rfedge.evaluate.clips import CodedClip, Drive
from rfedge.evaluate.compare.measure import quality_rows
from rfedge.evaluate.compare.rows import QualityRow
from rfedge.evaluate.noted_coder import FrameNotes, NotedCoder
from rfedge.evaluate.performance import Performance
from rfedge.evaluate.rate_curve import LPIPS
from rfedge.evaluate.rivals import CodedPictures, Rival
from rfedge.results import as_json

SUBMISSION = "submission.json"
PRIOR = "prior"
PACKET, RAW, PNG = ".packet", ".yuv", ".png"
AT_LEAST_1 = Range(low=1)
Tell = Callable[[str], None]


@dataclass(frozen=True)
class CodedPoint:
    """A drive at one operating point: its files, and what the submission says of it.

    ``cpu_ms``: processor time of the whole command over the drive, as stated; None if it is not.
    """

    point: float
    folder: Path
    frame_bytes: tuple[int, ...]
    cpu_ms: float | None

    def packets(self) -> list[bytes]:
        """Return the content of the packets; raises as ``check_files`` where one is missing."""
        self.check_files()
        return [self._file(k, PACKET).read_bytes() for k in range(len(self.frame_bytes))]

    def pictures(self, size_px: tuple[int, int]) -> list[I420]:
        """Return the decoded pictures; raise ``InvalidData`` for one of another size."""
        suffix = self.check_files()
        return [read_picture(self._file(k, suffix), size_px) for k in range(len(self.frame_bytes))]

    def check_files(self) -> str:
        """Check that there is one packet and one picture a frame and nothing else, and that
        packets have the bytes that are stated; return the suffix of the pictures.

        Raises ``InvalidData`` naming the file.
        """
        there = _names(self.folder)
        suffix = RAW if f"{0:04d}{RAW}" in there else PNG
        for index, stated in enumerate(self.frame_bytes):
            for wanted in (PACKET, suffix):
                if f"{index:04d}{wanted}" not in there:
                    last = len(self.frame_bytes) - 1
                    raise InvalidData(
                        f"{self._file(index, wanted)} is missing; every frame of 0 to {last} has a "
                        f"packet ({PACKET}) and a picture ({RAW} or {PNG}, one kind for all)"
                    )
            self._check_bytes(index, stated)
        self._check_nothing_else(there, suffix)
        return suffix

    def _check_bytes(self, index: int, stated: int) -> None:
        path = self._file(index, PACKET)
        found = path.stat().st_size
        if found < 1:
            raise InvalidData(f"{path} is empty; a frame takes at least one byte to send")
        if found != stated:
            raise InvalidData(f"{path} has {found} bytes, {SUBMISSION} states {stated}")

    def _check_nothing_else(self, there: Iterable[str], suffix: str) -> None:
        count = len(self.frame_bytes)
        known = {f"{k:04d}{wanted}" for k in range(count) for wanted in (PACKET, suffix)}
        more = sorted(set(there) - known)
        if more:
            raise InvalidData(
                f"{self.folder / more[0]} is no packet or picture of frames 0 to {count - 1}; "
                "what is sent must be counted: remove it, or put it into packets"
            )

    def _file(self, index: int, suffix: str) -> Path:
        return self.folder / f"{index:04d}{suffix}"


def _names(folder: Path) -> set[str]:
    """Return the names in a folder of files; raise ``InvalidData`` for anything but files."""
    if not folder.is_dir():
        raise InvalidData(f"{folder} is missing: {SUBMISSION} names it")
    for path in folder.iterdir():
        if path.is_symlink() or not path.is_file():
            raise InvalidData(f"{path} is a link, folder or device; only files are handed in")
    return {path.name for path in folder.iterdir()}


def read_picture(path: Path, size_px: tuple[int, int]) -> I420:
    """Return a decoded picture of (width, height); raise ``InvalidData`` for another size."""
    width, height = size_px
    if path.suffix == RAW:
        try:
            return I420.unpacked(size_px, path.read_bytes())
        except InvalidInput as error:
            raise InvalidData(f"{path}: {error.problem}") from None
    picture = i420_from_rgb(read_rgb(path))
    if picture.size_px != size_px:
        found = f"{picture.size_px[0]}x{picture.size_px[1]}"
        raise InvalidData(f"{path} has {found} px, the drive has {width}x{height}")
    return picture


@dataclass(frozen=True)
class Submission:
    """A submission, read but not yet checked against drives. ``prior``: files both ends hold."""

    method: str
    version: str
    command: str
    cpu: str
    withheld: bool
    """Whether it says that its coder gave the same packets when later frames were withheld."""
    prior: tuple[Path, ...]
    drives: Mapping[str, tuple[CodedPoint, ...]]

    @property
    def prior_bytes(self) -> int:
        """Size of all that both ends hold beforehand."""
        return sum(path.stat().st_size for path in self.prior)


def read_submission(folder: Path, benchmark: Benchmark) -> Submission:
    """Read ``submission.json``; raise ``InvalidData`` naming the key that is wrong in it.

    Drives must be the benchmark's, all that it requires among them, at no fewer points than it
    asks for. Files are looked at by ``check_submission``.
    """
    path = folder / SUBMISSION

    def fail(key: str, problem: str) -> InvalidData:
        return InvalidData(f"{path}: {key} {problem}")

    try:
        table = Table(json.loads(path.read_text(encoding="utf-8")), fail)
    except (OSError, ValueError) as error:
        raise InvalidData(f"{path}: not a readable submission ({error})") from None
    if table.text("benchmark") != benchmark.version:
        raise table.error("benchmark", f"must be {benchmark.version!r}")
    drives = [Table(v, fail, f"drives[{i}]") for i, v in enumerate(table.items("drives"))]
    submission = Submission(
        method=table.text("method"),
        version=table.text("version"),
        command=table.text("command"),
        cpu=table.text("cpu"),
        withheld=table.flag("later_frames_withheld", False),
        prior=_prior(folder, [str(name) for name in table.items("prior", default=())]),
        drives={drive.text("name"): _points(folder, drive, benchmark) for drive in drives},
    )
    table.finish()
    _check_drives(path, submission, len(drives), benchmark)
    return submission


def _check_drives(path: Path, submission: Submission, drives: int, benchmark: Benchmark) -> None:
    if len(submission.drives) < drives:
        raise InvalidData(
            f"{path}: names {drives} drives, of which only {len(submission.drives)} differ"
        )
    for drive in benchmark.drives:
        if drive.required and drive.name not in submission.drives:
            raise InvalidData(
                f"{path}: {drive.name} is missing, which {benchmark.version} requires"
            )


def _prior(folder: Path, names: Sequence[str]) -> tuple[Path, ...]:
    stated = {f"{PRIOR}/{Path(name).name}" for name in names}
    wrong = sorted(set(names) - stated)
    if wrong:
        raise InvalidData(f"{folder / SUBMISSION}: prior {wrong[0]!r} is not {PRIOR}/FILE")
    lies = (folder / PRIOR).is_dir()
    there = {f"{PRIOR}/{name}" for name in (_names(folder / PRIOR) if lies else ())}
    if there != stated:
        odd = min(there ^ stated)
        what = "is missing" if odd in stated else f"is not in {SUBMISSION}"
        raise InvalidData(f"{folder / odd} {what}; priors are listed and handed in")
    return tuple(folder / name for name in sorted(stated))


def _points(folder: Path, table: Table, benchmark: Benchmark) -> tuple[CodedPoint, ...]:
    try:
        drive = benchmark.drive(table.text("name"))
    except InvalidInput as error:
        raise table.error("name", f"of {error.problem}") from None
    items = table.items("points")
    least = benchmark.scoring.least_points
    if len(items) < least:
        raise table.error("points", f"has {len(items)}, at least {least} are needed")
    table.finish()

    def point(index: int, value: object) -> CodedPoint:
        each = Table(value, lambda key, problem: table.error(key, problem), f"points[{index}]")
        sizes = each.items("frame_bytes")
        if len(sizes) != drive.frames:
            raise each.error("frame_bytes", f"has {len(sizes)}, {drive.name} {drive.frames} frames")
        whole = [
            each.checked_whole(f"frame_bytes[{k}]", n, AT_LEAST_1) for k, n in enumerate(sizes)
        ]
        cpu_ms = each.number("cpu_ms", Range(low=0)) if "cpu_ms" in each else None
        made = CodedPoint(each.number("point"), _inside(folder, each), tuple(whole), cpu_ms)
        each.finish()
        return made

    return tuple(point(index, value) for index, value in enumerate(items))


def _inside(folder: Path, table: Table) -> Path:
    named = table.text("folder")
    if PurePosixPath(named).is_absolute() or ".." in PurePosixPath(named).parts:
        raise table.error("folder", f"is {named!r}, outside the submission")
    path = folder / named
    if not path.resolve().is_relative_to(folder.resolve()):
        raise table.error("folder", f"{named!r} leads out of the submission")
    return path


CheckDecoder = Callable[[CodedPoint, Drive, Path], None]
"""Runs a decoder on a point of a drive with a folder of priors, as ``method.check_decoder``."""

CHECKED = (
    "the drives' frames have the digests of the definition",
    "every frame has one packet and one picture of its size, and there are no other files",
    "bytes are the sizes of the packets; PSNR and SSIM are of the pictures that were handed in",
    "curves span the first window, with points close enough together in every window scored",
)
CHECKED_BY_DECODER = (
    "the decoder that the checker named makes these pictures from the packets alone, and the first "
    "half of them from the first half of the packets"
)
NOT_CHECKED_WITHOUT_DECODER = (
    "that the packets show the pictures: no --decoder was named; nor that frame k is shown from "
    "packets 0 to k"
)
NOT_CHECKED = (
    "that packets were made without later frames: that takes the coder (benchmark run)",
    "that coder and decoder hold nothing of the drive but the prior, and what that was made of",
    "processor times, which are stated",
)


def check_submission(
    folder: Path,
    benchmark: Benchmark,
    datasets: Mapping[str, Path],
    *,
    tell: Tell,
    check_decoder: CheckDecoder | None = None,
    lpips: FrameNotes | None = None,
) -> dict[str, Any]:
    """Check a submission against its drives and return what it scores, as a result's content.

    ``datasets``: where drives lie that are not among the samples. ``check_decoder`` runs
    a decoder on the packets of each point. With ``lpips`` the first anchor is coded here, too, to
    compare by that. Raises ``InvalidData`` naming what is wrong with the
    submission, ``InvalidInput`` for a drive that is not the benchmark's or curves that cannot be
    compared, and what ``check_decoder`` does.
    """
    submission = read_submission(folder, benchmark)
    rows, break_even, curves, by_lpips = [], [], [], list[QualityRow]()
    for name, points in submission.drives.items():
        drive = benchmark.drive(name).read(datasets.get(name))
        tell(f"{name}: {len(points)} points")
        clips = [_clip(point, drive, lpips) for point in points]
        if check_decoder is not None:
            for point in points:
                check_decoder(point, drive, folder / PRIOR)
        prior_bytes = submission.prior_bytes
        scored = score_rows(benchmark, drive.clip(), submission.method, clips, prior_bytes)
        rows += scored[0]
        break_even += scored[1]
        curves.append(_curve(drive, points, clips))
        if lpips is not None:
            ours = Performance(submission.method, tuple(clips), math.inf)
            by_lpips += _lpips_rows(drive, ours, benchmark.anchors[0], lpips)
    withheld = "stated, not checked" if submission.withheld else "not stated"
    return {
        "benchmark": benchmark.version,
        "definition_sha256": benchmark.sha256,
        "submission": {
            **{key: getattr(submission, key) for key in ("method", "version", "command", "cpu")},
            "later_frames_withheld": withheld,
            "prior": {p.name: _sha256(p.read_bytes()) for p in submission.prior},
            "prior_bytes": submission.prior_bytes,
        },
        "checked": [*CHECKED, *([CHECKED_BY_DECODER] if check_decoder else [])],
        "not_checked": [*([] if check_decoder else [NOT_CHECKED_WITHOUT_DECODER]), *NOT_CHECKED],
        "rows": as_json(rows),
        LPIPS.name: as_json(by_lpips),
        "break_even": as_json(break_even),
        "curves": curves,
    }


def _lpips_rows(
    drive: Drive, ours: Performance, anchor: Rival, lpips: FrameNotes
) -> list[QualityRow]:
    """Return the row against an anchor that is coded here: its recorded clips have no LPIPS."""
    coder = NotedCoder(anchor, lpips)
    clips = tuple(coder.code(drive.frames, drive.name.rate_hz, p) for p in anchor.points)
    theirs = Performance(anchor.name, clips, math.inf)
    return quality_rows(LPIPS, drive.clip(), ours, {anchor.name: [theirs]})


def _clip(point: CodedPoint, drive: Drive, noted: FrameNotes | None) -> CodedClip:
    """Measure a point against the drive's own frames."""
    cpu_ms = float("inf") if point.cpu_ms is None else point.cpu_ms
    pictures = point.pictures(drive.frames[0].size_px)
    made = CodedPictures(point.frame_bytes, pictures, cpu_ms, float("inf"))
    notes = {} if noted is None else noted.of(pictures, drive.frames)
    return made.measured(point.point, drive.frames, **notes)


def _curve(drive: Drive, points: Sequence[CodedPoint], clips: Sequence[CodedClip]) -> object:
    packets = hashlib.sha256()
    for point in points:
        for packet in point.packets():
            packets.update(hashlib.sha256(packet).digest())
    return {
        "scene": drive.name.scene,
        "hz": drive.name.rate_hz,
        "packets_sha256": packets.hexdigest(),
        "point": [point.point for point in points],
        "psnr_db": [clip.psnr_db() for clip in clips],
        "bytes_per_frame": [clip.bytes_per_frame() for clip in clips],
        "stated_cpu_ms": [
            None if point.cpu_ms is None else point.cpu_ms / len(drive.frames) for point in points
        ],
    }


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
