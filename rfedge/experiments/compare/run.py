"""Run a comparison: drives and a field in, one result file out, the cost said before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from rfcore.field import load_field
from rfedge.experiments.cells import CellStore
from rfedge.experiments.clips import ClipCoder, DriveName
from rfedge.experiments.compare.bit_split import SplitClip, split_rows
from rfedge.experiments.compare.drives import CompareJob, DriveComparison, read_drive_comparisons
from rfedge.experiments.compare.foreground import foreground_row
from rfedge.experiments.compare.measure import (
    BEST,
    MIDDLE_DB,
    Performance,
    break_even_row,
    compare_rows,
    curve_rows,
    perform,
    seconds_left,
)
from rfedge.results import provenance, revision, write_result

__all__ = ["run_compare"]

ANCHOR = "x264-lowdelay"
Row = dict[str, Any]


def run_compare(job: CompareJob, console: Console) -> dict[str, Any]:
    """Code every drive with every coder, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    for text in (*job.drives, *job.decimated, *job.backgrounds):
        DriveName.parse(text)
    field = load_field(job.field)
    bouts = read_drive_comparisons(job, field)
    store = CellStore(job.cells)
    left_s = sum(seconds_left(bout.contest, bout.coders, store) for bout in bouts)
    cells = sum(len(coder.points) for bout in bouts for coder in bout.coders)
    console.print(f"{cells} clips to code, about {left_s / 60:.1f} minutes of them left to do")
    tables: dict[str, list[Row]] = {}
    for bout in bouts:
        for name, rows in _tables(job, bout, store, console).items():
            tables.setdefault(name, []).extend(rows)
    result = {
        "case": "compare",
        **provenance(revision()),
        "quick": job.quick,
        "field_id": field.field_id,
        "field_bytes": job.field.stat().st_size,
        "frames": {f"{b.contest.scene}@{b.contest.rate_hz:g}": _frames(b) for b in bouts},
        **tables,
    }
    write_result(job.out, result)
    _print(tables["rows"], console)
    return result


def _tables(
    job: CompareJob, bout: DriveComparison, store: CellStore, console: Console
) -> dict[str, list[Row]]:
    contest = bout.contest

    def performed(coder: ClipCoder) -> Performance:
        console.print(f"  {contest.scene} {contest.rate_hz:g} Hz: {coder.name}")
        return perform(contest, coder, store, retime=job.retime)

    families = {n: [performed(c) for c in family] for n, family in bout.families.items()}
    methods = [performed(coder) for coder in bout.methods]
    anchor, field_bytes = families[ANCHOR][0], job.field.stat().st_size
    foreground = []
    if bout.foreground_only is not None:
        theirs = performed(bout.foreground_only).clips
        foreground = [foreground_row(contest, methods[0].clips, theirs, bout.foregrounds)]
    return {
        "rows": [row for method in methods for row in compare_rows(contest, method, families)],
        "break_even": [break_even_row(contest, m, anchor, field_bytes) for m in methods],
        "bits": _bits(job, bout, methods[0], store),
        "foreground": foreground,
        "curves": curve_rows(contest, methods, families),
    }


def _bits(job: CompareJob, bout: DriveComparison, ours: Performance, store: CellStore) -> list[Row]:
    contest, crf = bout.contest, ours.nearest(MIDDLE_DB).point
    clip = SplitClip(contest.frames, bout.seen, bout.foregrounds, job.preset, crf)
    key = {**contest.cell_key(bout.methods[0], crf), "split": 1, "background": bout.background}
    same = {"scene": contest.scene, "hz": contest.rate_hz, "method": ours.name, "crf": crf}
    return [same | row for row in store.rows(key, lambda: split_rows(clip))]


def _frames(bout: DriveComparison) -> dict[str, Any]:
    return {"count": len(bout.contest.frames), "sha256": bout.contest.frames_digest}


def _print(rows: Sequence[Row], console: Console) -> None:
    table = Table("scene", "Hz", "method", "rival", "window dB", "BD-rate %", "95 %", "CPU ms")
    for row in rows:
        low, high = row["ci95"]
        table.add_row(
            row["scene"],
            f"{row['hz']:g}",
            row["method"].rsplit("-", 1)[0],
            row["rival_setting"] + (" (best)" if row["rival"] == BEST else ""),
            "{:g}..{:g}".format(*row["window_db"]),
            f"{row['bd_rate_percent']:.1f}",
            f"{low:.1f}..{high:.1f}",
            f"{row['cpu_ms']:.0f} / {row['rival_cpu_ms']:.0f}",
        )
    console.print(table)
