"""``rfedge-bench v1``: its frozen definition, and what a codec scores by it.

``v1.toml`` names drives, anchors with every encoder option, windows of quality, the seed of the
intervals and the rules. ``v1_anchors.json`` holds what the anchors made of each drive, a value per
frame, and its digest stands in the definition: a score does not depend on the encoders of the
machine that checks. A change to either file is another benchmark.

Errors of the luma are kept as sums of squares, which are whole numbers and therefore exact.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from lab.report import Report, bars
from rfcore.errors import InvalidData, InvalidInput
from rfcore.files import write_whole
from rfcore.tables import Range, Table
from rfedge.evaluate.clips import Clip, CodedClip, Drive, DriveName, read_drive
from rfedge.evaluate.compare.measure import break_even_row
from rfedge.evaluate.compare.rows import DRIVE, BreakEvenRow, QualityRow
from rfedge.evaluate.performance import Performance
from rfedge.evaluate.rate_curve import (
    LPIPS,
    RateCurve,
    Window,
    bd_rate_interval,
    bd_rate_percent,
    rate_curve,
)
from rfedge.evaluate.rivals import Rival
from rfedge.report.tables import Column, columns, shown
from rfedge.report.tables import Table as ScoreTable
from rfedge.results import Result, rows_of
from rfedge.samples import sample_path

V1 = Path(__file__).parent / "v1.toml"
POSITIVE, COUNT = Range(low=1e-9), Range(low=1)
SSIM_DIGITS = 6


@dataclass(frozen=True)
class BenchmarkDrive:
    """A drive as the definition names it.

    ``sha256`` is ``Drive.digest`` of its frames; ``dataset`` where it lies among the samples, None
    for one that everybody has to get; ``may_learn_from`` all that a prior may be made of.
    """

    name: str
    hz: float
    frames: int
    size_px: tuple[int, int]
    sha256: str
    dataset: str | None
    get: str
    may_learn_from: str
    required: bool

    def read(self, dataset: Path | None = None) -> Drive:
        """Read the frames from ``dataset`` or, without one, from the samples.

        Raises ``InvalidInput`` if there is none or its frames are others, ``DatasetError`` if it
        cannot be read.
        """
        if dataset is None and self.dataset is None:
            raise InvalidInput("drive", f"{self.name} is not here: {self.get}")
        path = sample_path(str(self.dataset)) if dataset is None else dataset
        drive = read_drive(DriveName(self.name, self.hz, path))
        self._check(drive, path)
        return drive

    def _check(self, drive: Drive, path: Path) -> None:
        sizes = {frame.size_px for frame in drive.frames}
        if len(drive.frames) != self.frames or sizes != {self.size_px}:
            shown = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
            wanted = f"{self.frames} of {self.size_px[0]}x{self.size_px[1]}"
            raise InvalidInput(
                "drive",
                f"{path} has {len(drive.frames)} frames of {shown} px, {self.name} has {wanted}",
            )
        if drive.digest != self.sha256:
            raise InvalidInput(
                "drive",
                f"the frames of {path} have the digest {drive.digest}, those of {self.name} have "
                f"{self.sha256}; get it: {self.get}",
            )


@dataclass(frozen=True)
class Scoring:
    """The rules by which curves are compared; ``v1.toml`` explains them."""

    windows_db: tuple[Window, ...]
    first_scored_frame: int
    least_points: int
    most_gap_db: float
    seed: int
    repetitions: int

    @property
    def scored(self) -> slice:
        """The frames that curves are made of."""
        return slice(self.first_scored_frame, None)

    def check_dense(self, curve: RateCurve, window_db: Window) -> None:
        """Raise ``InvalidInput`` unless points of ``curve`` lie close together in the window."""
        low, high = window_db
        inside = [(a, b) for a, b in pairwise(curve.psnr_db) if a < high and b > low]
        for worse, better in inside:
            if better - worse > self.most_gap_db:
                raise InvalidInput(
                    "points",
                    f"none between {worse:.2f} and {better:.2f} dB, which is "
                    f"{better - worse:.2f} dB of the window {low:g}..{high:g}; the limit is "
                    f"{self.most_gap_db:g} dB: add points",
                )


AnchorClips = Mapping[tuple[str, str], tuple[CodedClip, ...]]
"""Curves by the names of drive and anchor."""


@dataclass(frozen=True)
class Benchmark:
    """A definition, read. ``sha256`` is that of its file; ``anchors`` begin with the headline's."""

    version: str
    sha256: str
    rules: Mapping[str, str]
    scoring: Scoring
    drives: tuple[BenchmarkDrive, ...]
    anchors: tuple[Rival, ...]
    recorded: Path
    recorded_sha256: str

    @cached_property
    def anchor_clips(self) -> AnchorClips:
        """The anchors' curves on the drives.

        Raises ``InvalidData`` if the file is not the one that the definition names.
        """
        content = self.recorded.read_bytes()
        found = hashlib.sha256(content).hexdigest()
        if found != self.recorded_sha256:
            raise InvalidData(
                f"{self.recorded} has the digest {found}, {self.version} names "
                f"{self.recorded_sha256}; take the file that came with the definition"
            )
        return _clips_of(json.loads(content), self.drives)

    def drive(self, name: str) -> BenchmarkDrive:
        """Return a drive by its name; raise ``InvalidInput`` listing those that there are."""
        found = {drive.name: drive for drive in self.drives}
        if name not in found:
            raise InvalidInput("drive", f"{name!r} is none of {', '.join(found)}")
        return found[name]


def read_benchmark(path: Path = V1) -> Benchmark:
    """Read a definition; raise ``InvalidData`` naming the key that is wrong in it."""

    def fail(key: str, problem: str) -> InvalidData:
        return InvalidData(f"{path}: {key} {problem}")

    content = path.read_bytes()
    table = Table(tomllib.loads(content.decode()), fail)
    recorded, rules = table.table("recorded"), table.value("rules")
    drives = [Table(v, fail, f"drives[{i}]") for i, v in enumerate(table.items("drives"))]
    anchors = [Table(v, fail, f"anchors[{i}]") for i, v in enumerate(table.items("anchors"))]
    benchmark = Benchmark(
        version=table.text("version"),
        sha256=hashlib.sha256(content).hexdigest(),
        rules={str(name): str(rule) for name, rule in rules.items()},
        scoring=_scoring(table.table("quality"), table.table("interval")),
        drives=tuple(map(_drive, drives)),
        anchors=tuple(map(_anchor, anchors)),
        recorded=path.parent / recorded.text("file"),
        recorded_sha256=recorded.text("sha256"),
    )
    for each in (table, recorded, *drives, *anchors):
        each.finish()
    return benchmark


def _scoring(quality: Table, interval: Table) -> Scoring:
    windows = quality.items("windows_db")
    scoring = Scoring(
        windows_db=tuple((float(low), float(high)) for low, high in windows),
        first_scored_frame=quality.whole("first_scored_frame", Range(low=0)),
        least_points=quality.whole("least_points", COUNT),
        most_gap_db=quality.number("most_gap_db", POSITIVE),
        seed=interval.whole("seed", Range(low=0)),
        repetitions=interval.whole("repetitions", COUNT),
    )
    quality.finish()
    interval.finish()
    return scoring


def _drive(table: Table) -> BenchmarkDrive:
    width, height = (int(n) for n in table.numbers("size_px", 2, COUNT))
    return BenchmarkDrive(
        name=table.text("name"),
        hz=table.number("hz", POSITIVE),
        frames=table.whole("frames", COUNT),
        size_px=(width, height),
        sha256=table.text("sha256"),
        dataset=table.value("dataset", None),
        get=table.text("get"),
        may_learn_from=table.text("may_learn_from"),
        required=table.flag("required"),
    )


def _anchor(table: Table) -> Rival:
    return Rival(
        table.text("name"),
        table.text("encoder"),
        table.text("decoder"),
        {str(name): str(value) for name, value in table.value("options").items()},
        tuple(table.numbers("crfs")),
    )


def record_anchors(
    benchmark: Benchmark, drives: Sequence[Drive], out: Path, tell: Callable[[str], None]
) -> None:
    """Code ``drives`` with every anchor at every point and write what a definition names.

    Beside bytes and errors stand the options that each encoder says it ran with. On the encoders
    that v1 was recorded with (PyAV's, of the version in the cells of ``lab/results/compare.json``)
    the file comes out as it is. Raises ``CodecError`` as ``Rival.code``.
    """
    lines = []
    for drive in drives:
        for anchor in benchmark.anchors:
            tell(f"{drive.name.scene}: {anchor.name}")
            clips = [anchor.code(drive.frames, drive.name.rate_hz, p) for p in anchor.points]
            row = _recorded_row(drive, anchor, clips)
            lines.append(json.dumps(row, separators=(",", ":")))
    write_whole(out, "[\n" + ",\n".join(lines) + "\n]\n")


def _recorded_row(drive: Drive, anchor: Rival, clips: Sequence[CodedClip]) -> dict[str, Any]:
    pixels = drive.frames[0].y.size
    return {
        "drive": drive.name.scene,
        "sha256": drive.digest,
        "anchor": anchor.name,
        "encoder": anchor.version,
        "point": [clip.point for clip in clips],
        "frame_bytes": [clip.frame_bytes.tolist() for clip in clips],
        "luma_sse": [np.rint(clip.luma_mse * pixels).astype(int).tolist() for clip in clips],
        "ssim": [clip.ssim.round(SSIM_DIGITS).tolist() for clip in clips],
    }


def _clips_of(rows: Sequence[Mapping[str, Any]], drives: Sequence[BenchmarkDrive]) -> AnchorClips:
    pixels = {drive.name: drive.size_px[0] * drive.size_px[1] for drive in drives}

    def clips(row: Mapping[str, Any]) -> tuple[CodedClip, ...]:
        columns = zip(row["point"], row["frame_bytes"], row["luma_sse"], row["ssim"], strict=True)
        return tuple(
            CodedClip(
                point,
                np.array(sizes, np.int64),
                np.array(errors, np.float64) / pixels[row["drive"]],
                np.array(ssim, np.float64),
                float("inf"),
            )
            for point, sizes, errors, ssim in columns
        )

    return {(row["drive"], row["anchor"]): clips(row) for row in rows}


@dataclass(frozen=True)
class BenchmarkRow:
    """A submission against one anchor over one window of luma PSNR, on one drive."""

    scene: str = field(metadata=shown("drive"))
    hz: float = field(metadata=shown("Hz", "g"))
    method: str
    rival: str = field(metadata=shown("anchor"))
    window_db: Window
    bd_rate_percent: float = field(metadata=shown("BD-rate %", "+.1f"))
    """BD-rate over all frames but the first; negative if the method needs fewer bytes."""
    ci95: Sequence[float] | None = field(metadata=shown("95 %", "{:.1f}..{:.1f}", "n/a"))
    """None if curves of resampled frames leave the window."""
    bd_rate_with_first_percent: float | None = field(
        metadata=shown("with frame 0, %", "+.1f", "n/a")
    )
    """BD-rate over all frames; None if a curve with the first frame does not span the window."""
    first_frame_bytes: int
    """Size at the point nearest to the middle of the window, as the SSIM."""
    rival_first_frame_bytes: int
    ssim: float
    rival_ssim: float


def score_rows(
    benchmark: Benchmark, clip: Clip, method: str, clips: Sequence[CodedClip], prior_bytes: int
) -> tuple[list[BenchmarkRow], list[BreakEvenRow]]:
    """Return how ``clips``, one drive coded at several points, compare with every anchor.

    With a prior, a row says what its bytes leave of the saving against the first anchor. Raises
    ``InvalidInput`` if there are too few points, if they do not span the first window, or lie too
    far apart in one that is scored.
    """
    scoring = benchmark.scoring
    if len(clips) < scoring.least_points:
        what = f"{len(clips)} on {clip.scene}, at least {scoring.least_points} are needed"
        raise InvalidInput("points", what)
    ours = Performance(method, tuple(clips), float("inf"))
    curve = rate_curve(clips, scoring.scored)
    headline, *wider = scoring.windows_db
    curve.check_spans(headline)
    rows = []
    for window in (headline, *filter(curve.spans, wider)):
        scoring.check_dense(curve, window)
        for anchor in benchmark.anchors:
            theirs = _performance(benchmark, clip, anchor)
            if rate_curve(theirs.clips, scoring.scored).spans(window):
                rows.append(_row(scoring, clip, ours, theirs, window))
    if not prior_bytes:
        return rows, []
    first = _performance(benchmark, clip, benchmark.anchors[0])
    return rows, [break_even_row(clip, ours, first, prior_bytes)]


def _performance(benchmark: Benchmark, clip: Clip, anchor: Rival) -> Performance:
    clips = benchmark.anchor_clips.get((clip.scene, anchor.name))
    if clips is None:
        raise InvalidData(f"{benchmark.recorded} has nothing of {anchor.name} on {clip.scene}")
    return Performance(anchor.name, clips, float("inf"))


def _row(
    scoring: Scoring, clip: Clip, ours: Performance, theirs: Performance, window: Window
) -> BenchmarkRow:
    near, rival_near = (who.nearest(sum(window) / 2) for who in (ours, theirs))
    bd_rate = _bd_rate(ours, theirs, scoring.scored, window)
    assert bd_rate is not None, "both curves span the window"
    return BenchmarkRow(
        scene=clip.scene,
        hz=clip.rate_hz,
        method=ours.name,
        rival=theirs.name,
        window_db=window,
        bd_rate_percent=bd_rate,
        ci95=_interval(scoring, ours, theirs, window),
        bd_rate_with_first_percent=_bd_rate(ours, theirs, slice(None), window),
        first_frame_bytes=int(near.frame_bytes[0]),
        rival_first_frame_bytes=int(rival_near.frame_bytes[0]),
        ssim=float(near.ssim[scoring.scored].mean()),
        rival_ssim=float(rival_near.ssim[scoring.scored].mean()),
    )


def _bd_rate(ours: Performance, theirs: Performance, frames: slice, window: Window) -> float | None:
    anchor, curve = (rate_curve(who.clips, frames) for who in (theirs, ours))
    if not (anchor.spans(window) and curve.spans(window)):
        return None
    return bd_rate_percent(anchor, curve, window)


def _interval(
    scoring: Scoring, ours: Performance, theirs: Performance, window: Window
) -> tuple[float, float] | None:
    rng = np.random.default_rng(scoring.seed)
    try:
        return bd_rate_interval(
            theirs.clips,
            ours.clips,
            window,
            rng,
            first=scoring.first_scored_frame,
            repetitions=scoring.repetitions,
        )
    except InvalidInput:
        return None


WINDOW = Column("dB", lambda row: row.window_db, "{:g}..{:g}")
FIRST_FRAME = Column(
    "first frame kB",
    lambda row: (row.first_frame_bytes / 1e3, row.rival_first_frame_bytes / 1e3),
    "{:.1f} ({:.1f})",
)


def score_parts(result: Result) -> Iterator[ScoreTable | str]:
    """Yield a checked submission's rows, what its prior costs, and what was not checked."""
    rows = rows_of(BenchmarkRow, result["rows"])
    shown_columns = columns(BenchmarkRow, "scene", "hz", "rival", WINDOW, *FIGURES, FIRST_FRAME)
    title = f"{result['submission']['method']}: {result['benchmark']}"
    yield ScoreTable(title, shown_columns, rows)
    by_lpips = rows_of(QualityRow, result.get(LPIPS.name, ()))
    if by_lpips:
        yield ScoreTable(f"By {LPIPS.title}", [DRIVE, *columns(QualityRow)], by_lpips)
    yield "\n".join(f"* {line}" for line in _remarks(result))


FIGURES = ("bd_rate_percent", "ci95", "bd_rate_with_first_percent")


def _bars(result: Result) -> Iterator[tuple[str, float]]:
    for row in rows_of(BenchmarkRow, result["rows"]):
        if row.window_db == result["rows"][0]["window_db"]:
            yield f"{row.scene}: {row.rival}", row.bd_rate_percent


REPORT = Report(
    "benchmark",
    "rfedge-bench v1",
    "What our codec scores in the frozen benchmark that anybody's codec can be handed in to.",
    score_parts,
    bars("BD-rate against the anchor, %", _bars),
)


def print_scores(console: Console, result: Result) -> None:
    """Print a checked submission's scores, and what was not checked."""
    for part in score_parts(result):
        if isinstance(part, ScoreTable):
            part.print(console)
        else:
            console.print(part, markup=False, highlight=False)


def _remarks(result: Result) -> list[str]:
    lines = []
    for row in rows_of(BreakEvenRow, result["break_even"]):
        passes = row.passes_to_break_even
        paid = "is never paid for" if passes is None else f"is paid for by {passes} passes"
        lines.append(f"{row.scene}: the prior of {row.field_bytes:,} bytes {paid}.")
    return lines + [f"Not checked: {what}." for what in result["not_checked"]]


def described(benchmark: Benchmark) -> str:
    """Return the definition in words: rules, drives and how to get them, anchors, windows."""
    windows = ", ".join(f"{low:g}..{high:g}" for low, high in benchmark.scoring.windows_db)
    lines = [f"{benchmark.version}, definition {benchmark.sha256}", f"windows: {windows} dB", ""]
    lines += [f"{name}: {rule}" for name, rule in benchmark.rules.items()]
    for drive in benchmark.drives:
        width, height = drive.size_px
        asked = "required" if drive.required else "optional"
        lines += [
            "",
            f"{drive.name}: {drive.frames} frames, {width}x{height}, {drive.hz:g} Hz, {asked}",
            f"  {drive.get}",
            f"  a prior may be made of: {drive.may_learn_from}",
        ]
    lines += ["", *(f"anchor {a.name}: {a.encoder} {dict(a.options)}" for a in benchmark.anchors)]
    return "\n".join(lines)
