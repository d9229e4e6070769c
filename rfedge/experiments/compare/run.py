"""Run a comparison: drives and a field in, one result file out.

What it will do and what that will take is said before it starts. The ends of every curve are coded
first, so that a window that cannot be spanned ends the run before its long part.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from rfedge.experiments.cells import CellStore, clip_key
from rfedge.experiments.clips import ClipCoder
from rfedge.experiments.compare.bit_split import SplitClip, split_rows
from rfedge.experiments.compare.drives import CompareJob, DriveComparison, read_drive_comparisons
from rfedge.experiments.compare.foreground import foreground_row
from rfedge.experiments.compare.measure import (
    break_even_row,
    compare_rows,
    curve_rows,
    ssim_rows,
)
from rfedge.experiments.compare.report import BitShareRow, print_compared
from rfedge.experiments.performance import (
    Performance,
    perform,
    seconds_left,
    spanning_points,
    time_in_turns,
)
from rfedge.experiments.rate_curve import Window
from rfedge.results import make_result, provenance, rows_of, write_result

__all__ = ["run_compare"]

PAID_AGAINST = "x264-lowdelay-psnr"
"""Whose bytes must be saved before a field is paid for."""


def run_compare(job: CompareJob, console: Console) -> dict[str, Any]:
    """Code every drive with every coder, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong, and
    ``InvalidInput`` after the ends of the curves if one cannot span the window.
    """
    comparisons = read_drive_comparisons(job)
    fields = dict.fromkeys(comparison.field for comparison in comparisons)
    store, made = CellStore(job.cells), provenance(list(fields))
    _announce(job, comparisons, store, console)
    for comparison in comparisons:
        _check_window(job, comparison, store, console)
    tables: dict[str, list[Any]] = {}
    for comparison in comparisons:
        for name, rows in _tables(job, comparison, store, console).items():
            tables.setdefault(name, []).extend(rows)
    content = {
        "quick": job.quick,
        "frames": {f"{b.clip.scene}@{b.clip.rate_hz:g}": _frames(b) for b in comparisons},
        **tables,
    }
    result = make_result("compare", made, content)
    write_result(job.out, result)
    print_compared(console, tables["rows"])
    return result


def _announce(
    job: CompareJob,
    comparisons: Sequence[DriveComparison],
    store: CellStore,
    console: Console,
) -> None:
    left_s = sum(seconds_left(c.clip, c.coders, store) for c in comparisons)
    clips = sum(len(coder.points) for c in comparisons for coder in c.coders)
    headline, *wider = map(_in_words, job.windows_db)
    also = f" (and {', '.join(wider)} where it is spanned)" if wider else ""
    console.print(
        f"BD-rates over {headline}{also}: {clips} clips to code, about {left_s / 60:.1f} minutes "
        "of them left to do. Points are added where a curve does not span the window: the ends of "
        "all curves are coded first."
    )


def _check_window(
    job: CompareJob, comparison: DriveComparison, store: CellStore, console: Console
) -> None:
    """Code the ends of every curve, ours first: the field decides how low it can reach."""
    clip, window = comparison.clip, job.windows_db[0]
    for coder in comparison.compared:
        points = spanning_points(clip, coder, store, window)
        added = [f"{point:g}" for point in points if point not in coder.points]
        if added:
            console.print(
                f"  {clip.scene} {clip.rate_hz:g} Hz: {coder.name} also at {', '.join(added)}, to "
                f"span {_in_words(window)}"
            )


def _in_words(window_db: Window) -> str:
    low_db, high_db = window_db
    return f"{low_db:g}..{high_db:g} dB"


def _tables(
    job: CompareJob, comparison: DriveComparison, store: CellStore, console: Console
) -> dict[str, list[Any]]:
    clip, window = comparison.clip, job.windows_db[0]

    def performed(coder: ClipCoder, window: Window | None) -> Performance:
        console.print(f"  {clip.scene} {clip.rate_hz:g} Hz: {coder.name}")
        return perform(clip, coder, store, window_db=window, timed=False)

    coded = [(coder, performed(coder, window)) for coder in comparison.compared]
    timed = time_in_turns(clip, coded, store, window, retime=job.retime)
    by_name = {each.name: each for each in timed}
    families = {n: [by_name[c.name] for c in f] for n, f in comparison.families.items()}
    methods = [by_name[coder.name] for coder in comparison.methods]
    for_ssim = {n: [performed(c, None) for c in f] for n, f in comparison.for_ssim.items()}
    anchor, field_bytes = families[PAID_AGAINST][0], comparison.field_bytes
    foreground = []
    if comparison.foreground_only is not None:
        # Its whole picture has a ceiling below any window: it is not asked to span one.
        theirs = performed(comparison.foreground_only, None).clips
        foreground = [foreground_row(clip, methods[0].clips, theirs, comparison.foregrounds)]
    return {
        "rows": [
            row
            for method in methods
            for row in compare_rows(
                clip, method, families, job.windows_db if method is methods[0] else [window]
            )
        ],
        "ssim": ssim_rows(clip, methods[0], for_ssim),
        "break_even": [break_even_row(clip, m, anchor, field_bytes) for m in methods],
        "bits": _bits(job, comparison, methods[0], store),
        "foreground": foreground,
        "curves": curve_rows(clip, methods, families),
    }


def _bits(
    job: CompareJob, comparison: DriveComparison, ours: Performance, store: CellStore
) -> list[BitShareRow]:
    clip, middle_db = comparison.clip, sum(job.windows_db[0]) / 2
    crf = ours.nearest(middle_db).point
    split = SplitClip(clip.frames, comparison.rendered, comparison.foregrounds, job.effort, crf)
    key = {
        **clip_key(clip, comparison.methods[0], crf),
        "split": 1,
        "background": comparison.background,
    }
    same = {"scene": clip.scene, "hz": clip.rate_hz, "method": ours.name, "crf": crf}
    rows = store.rows(key, lambda: split_rows(split))
    return rows_of(BitShareRow, [same | row for row in rows])


def _frames(comparison: DriveComparison) -> dict[str, Any]:
    clip = comparison.clip
    return {
        "count": len(clip.frames),
        "sha256": clip.frames_digest,
        "field_id": comparison.rendered.field_id,
        "field_bytes": comparison.field_bytes,
    }
