"""Run a comparison: drives and a field in, one result file out.

What it will do and what that will take is said before it starts. The ends of every curve are coded
first, so that a window that cannot be spanned ends the run before its long part.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from rfcore.dataset.bag_file import is_bag
from rfcore.dataset.read import read_source
from rfcore.errors import InvalidInput
from rfcore.named_class import module_file
from rfcore.program import working
from rfedge.arguments import time_text
from rfedge.evaluate.clips import QUICK, Clip, ClipCoder, DriveName, DriveOfField
from rfedge.evaluate.compare import EvalCompare
from rfedge.evaluate.compare.bits import SplitClip, split_rows
from rfedge.evaluate.compare.drives import (
    PAID_AGAINST,
    DriveComparison,
    asked_families,
    jobs_of_drives,
    read_drive_comparisons,
)
from rfedge.evaluate.compare.foreground import foreground_row
from rfedge.evaluate.compare.measure import (
    WINDOWS_DB,
    break_even_row,
    compare_rows,
    curve_rows,
    quality_rows,
)
from rfedge.evaluate.compare.rows import BitShareRow, compare_parts
from rfedge.evaluate.performance import (
    ROUNDS,
    Performance,
    WindowNotReached,
    perform,
    seconds_left,
    spanning_points,
    time_in_turns,
)
from rfedge.evaluate.rate_curve import LPIPS, QUICK_POINTS, SSIM, Window
from rfedge.evaluate.runner import Run, clip_key, coded_clip
from rfedge.jobs import CellStore, Job, Tell
from rfedge.results import rows_of

PARTS = 4
"""A drive's coders are split into so many jobs, each of which renders the drive anew in seconds."""
WINDOWS_TRIED = 5
"""Windows that are looked for in place of one that a codec does not reach."""
QUICK_ROUNDS = 1
"""Rounds of processor times of a quick run."""
TOLD_EVERY_S, TOLD_SHARE = 3.0, 0.05
"""Progress is told after so many seconds, and after this share of the time so far."""


def run_compare(job: EvalCompare, console: Console) -> dict[str, Any]:
    """Code every drive with every coder, write the result and print its rows.

    With several processes or on Ray, jobs leave coded clips in ``job.cells``, which are then found
    there; processor times are taken here, with the machine to itself. Raises ``InvalidInput`` or
    ``DatasetError`` before anything is coded if an input is wrong, and ``InvalidInput`` after the
    ends of the curves if one cannot span the window.
    """
    asked_families(job)
    comparisons = read_drive_comparisons(job)
    run = Run.begin("compare", job, _inputs(job), console)
    _announce(job, comparisons, run)
    run.parallel(_jobs(job), job.processes, job.ray)
    progress = _Progress(comparisons, run.store)
    progress.code(ends=True)
    with working("looking for points that span the window"):
        _check_window(job, comparisons, run)
    progress.code(ends=False)
    tables: dict[str, list[Any]] = {}
    for comparison in comparisons:
        for name, rows in _tables(job, comparison, run).items():
            tables.setdefault(name, []).extend(rows)
    frames = {f"{b.clip.scene}@{b.clip.rate_hz:g}": _frames(b) for b in comparisons}
    return run.finish({"frames": frames, **tables}, compare_parts)


def _inputs(job: EvalCompare) -> list[Path]:
    """Return the files of fields, drives and codecs that the command names; of a class, its
    module's."""
    drives = [DriveOfField.parse(text, job.field) for text in (*job.drives, *job.decimated)]
    shown = [drive.name.dataset for drive in drives]
    shown += [DriveName.parse(text).dataset for text in job.background]
    # Of a folder the file that describes it; a bag is no such file, and long to read.
    files = [p if p.is_file() or is_bag(p) else read_source(p).file for p in shown]
    named = [*(str(drive.field) for drive in drives), *job.method]
    return list(dict.fromkeys([*(module_file(each) or Path(each) for each in named), *files]))


def _windows_db(job: EvalCompare) -> tuple[Window, ...]:
    """Return the windows of quality asked about, the one that must be spanned first."""
    return WINDOWS_DB if job.window is None else (job.window,)


def _jobs(job: EvalCompare) -> list[Job]:
    """Return a job for each part of the coders of each drive."""
    folder = Path.cwd()
    return [
        Job(f"drive-{number}-part-{part + 1}", partial(_code_part, one, part, folder))
        for number, one in enumerate(jobs_of_drives(job), 1)
        for part in range(PARTS)
    ]


def _code_part(job: EvalCompare, part: int, folder: Path, tell: Tell) -> None:
    with chdir(folder):  # workers run in folders of their own
        (comparison,) = read_drive_comparisons(job)
        store, clip = CellStore(job.cells), comparison.clip
        spanning = {coder.name for coder in comparison.compared}
        every = list({coder.name: coder for coder in comparison.coders}.values())
        for coder in every[part::PARTS]:
            window = _windows_db(job)[0] if coder.name in spanning else None
            with suppress(WindowNotReached):  # the check that follows says what to do
                perform(clip, coder, store, window_db=window, timed=False)
            tell(f"{clip.scene} {clip.rate_hz:g} Hz: {coder.name}")


def _announce(job: EvalCompare, comparisons: Sequence[DriveComparison], run: Run) -> None:
    left_s = sum(seconds_left(c.clip, c.coders, run.store) for c in comparisons) / job.processes
    clips = sum(len(coder.points) for c in comparisons for coder in c.coders)
    headline, *wider = map(_in_words, _windows_db(job))
    also = f" (and {', '.join(wider)} where it is spanned)" if wider else ""
    part = ""
    if job.quick:
        most = QUICK.count * QUICK.frames
        part = f" ({clips / len(comparisons):.0f} a drive, of at most {most} pictures)"
    run.tell(
        f"BD-rates over {headline}{also}: {clips} clips to code{part}, about {time_text(left_s)} "
        "of them left to do. Points are added where a curve does not span the window: the ends of "
        "all curves are coded first."
    )


class _Progress:
    """Codes the clips that are not there yet; says on stderr how many are, and the time left."""

    def __init__(self, comparisons: Sequence[DriveComparison], store: CellStore) -> None:
        self._store = store
        self._waiting = [
            (comparison.clip, coder, point)
            for comparison in comparisons
            for coder in comparison.coders
            for point in coder.points
            if not store.has(clip_key(comparison.clip, coder, point))
        ]
        self._total, self._done = len(self._waiting), 0
        self._began_s = self._told_s = monotonic()

    def code(self, *, ends: bool) -> None:
        """Code the ends of all curves, or what is between."""
        for clip, coder, point in self._waiting:
            if (point in (coder.points[0], coder.points[-1])) is ends:
                coded_clip(clip, coder, point, self._store)
                self._done += 1
                self._tell(f"{clip.scene} {clip.rate_hz:g} Hz, {coder.name}")

    def _tell(self, last: str) -> None:
        now_s = monotonic()
        taken_s = now_s - self._began_s
        if now_s - self._told_s >= max(TOLD_EVERY_S, TOLD_SHARE * taken_s):
            left_s = taken_s / self._done * (self._total - self._done)
            text = f"  {self._done} of {self._total} clips, about {time_text(left_s)} left: {last}"
            print(text, file=sys.stderr, flush=True)
            self._told_s = now_s


def _check_window(job: EvalCompare, comparisons: Sequence[DriveComparison], run: Run) -> None:
    """Code the ends of every curve, ours first: the field decides how low it can reach."""
    window = _windows_db(job)[0]
    for clip, coder in _curves(comparisons):
        try:
            points = spanning_points(clip, coder, run.store, window)
        except WindowNotReached as error:
            raise InvalidInput(
                "window", f"{error.problem}; {_remedy(comparisons, run, error)}"
            ) from error
        added = [f"{point:g}" for point in points if point not in coder.points]
        if added:
            run.tell(
                f"  {clip.scene} {clip.rate_hz:g} Hz: {coder.name} also at {', '.join(added)}, to "
                f"span {_in_words(window)}"
            )


def _curves(comparisons: Sequence[DriveComparison]) -> Iterator[tuple[Clip, ClipCoder]]:
    for comparison in comparisons:
        for coder in comparison.compared:
            yield comparison.clip, coder


def _remedy(comparisons: Sequence[DriveComparison], run: Run, error: WindowNotReached) -> str:
    """Return what to do, after coding the ends of all curves of the windows that are tried."""
    nearest_db = error.nearest_db
    for _ in range(WINDOWS_TRIED):
        if nearest_db is None:
            break
        try:
            for clip, coder in _curves(comparisons):
                spanning_points(clip, coder, run.store, nearest_db)
        except WindowNotReached as another:
            nearest_db = another.nearest_db
        else:
            low_db, high_db = nearest_db
            return f"all codecs reach --window {low_db:g} {high_db:g} on these drives"
    return "no other window is reached by all codecs: compare the drives one at a time"


def _in_words(window_db: Window) -> str:
    low_db, high_db = window_db
    return f"{low_db:g}..{high_db:g} dB"


def _tables(job: EvalCompare, comparison: DriveComparison, run: Run) -> dict[str, list[Any]]:
    clip, window = comparison.clip, _windows_db(job)[0]

    def performed(coder: ClipCoder, window: Window | None) -> Performance:
        coded = perform(clip, coder, run.store, window_db=window, timed=False)
        return replace(coded, least_points=QUICK_POINTS) if job.quick else coded

    coded = [(coder, performed(coder, window)) for coder in comparison.compared]
    with working(f"{clip.scene} {clip.rate_hz:g} Hz: taking processor times"):
        rounds = QUICK_ROUNDS if job.quick else ROUNDS
        timed = time_in_turns(clip, coded, run.store, window, retime=job.retime, rounds=rounds)
    by_name = {each.name: each for each in timed}
    families = {n: [by_name[c.name] for c in f] for n, f in comparison.families.items()}
    methods = [by_name[coder.name] for coder in comparison.methods]
    for_ssim = {n: [performed(c, None) for c in f] for n, f in comparison.for_ssim.items()}
    anchor, field_bytes = families[PAID_AGAINST][0], comparison.field_bytes
    foreground = []
    if comparison.foreground_only is not None:
        # Its whole picture has a ceiling below any window: it is not asked to span one.
        theirs = performed(comparison.foreground_only, None).clips
        masks = [comparison.foregrounds[k] for k in clip.coded]
        foreground = [foreground_row(clip, methods[0].clips, theirs, masks)]
    return {
        "rows": [
            row
            for method in methods
            for row in compare_rows(
                clip,
                method,
                families,
                _windows_db(job) if method is methods[0] else [window],
                interval=not job.quick,
            )
        ]
        + [
            row
            for own in comparison.own
            for row in compare_rows(
                clip,
                by_name[own.name],
                {name: those for name, those in families.items() if name != own.name},
                [window],
                interval=not job.quick,
            )
        ],
        SSIM.name: quality_rows(SSIM, clip, methods[0], for_ssim),
        LPIPS.name: quality_rows(LPIPS, clip, methods[0], families) if job.lpips_weights else [],
        "break_even": [break_even_row(clip, m, anchor, field_bytes) for m in methods],
        "bits": [] if job.quick else _bits(job, comparison, methods[0], run),
        "foreground": foreground,
        "curves": curve_rows(clip, methods, families),
    }


def _bits(
    job: EvalCompare, comparison: DriveComparison, ours: Performance, run: Run
) -> list[BitShareRow]:
    clip, middle_db = comparison.clip, sum(_windows_db(job)[0]) / 2
    crf = ours.nearest(middle_db).point
    rendered, foregrounds = comparison.rendered, comparison.foregrounds
    split = [
        SplitClip(clip.frames[part], rendered.of_run(part), foregrounds[part], job.effort, crf)
        for part in clip.runs
    ]
    key = {
        **clip_key(clip, comparison.methods[0], crf),
        "split": 1,
        "background": comparison.background,
    }
    same = {"scene": clip.scene, "hz": clip.rate_hz, "method": ours.name, "crf": crf}
    with working(f"{clip.scene} {clip.rate_hz:g} Hz: splitting the bits by what pixels show"):
        rows = run.store.rows(key, lambda: split_rows(split))
    return rows_of(BitShareRow, [same | row for row in rows])


def _frames(comparison: DriveComparison) -> dict[str, Any]:
    clip = comparison.clip
    return {
        "count": len(clip.frames),
        **({} if clip.part is None else {"part": clip.part}),
        "sha256": clip.frames_digest,
        "field_id": comparison.rendered.field_id,
        "field_bytes": comparison.field_bytes,
    }
