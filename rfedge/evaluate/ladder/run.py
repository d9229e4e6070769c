"""Measure a ladder: fields and a drive in, ``ladder.json`` out.

A rung is one setting of the sender. Measured are, for splats, every level of detail with three, one
and no temporal references at three efforts, and each other setting alone against the full rung; for
hash grids, samples along a ray and the picture's scale. A rung is judged by its bits at equal
quality against the first one, and by whether another beats it in both time and bits. Of each
quality, every effort of tracking is measured: what finding the pose takes on top, and what poses
so found cost in bits against the dataset's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.codec.sender.ladder import Rung, TrackingEffort, quality_name
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField
from rfcore.field.interface import NGP, SPLATS
from rfcore.field.quality import DETAILS, Quality
from rfedge.arguments import open_field
from rfedge.evaluate.clips import ONE_RUN, Drive, DriveName, read_drive
from rfedge.evaluate.ladder import LEAST_FRAMES, EvalLadder
from rfedge.evaluate.ladder.measure import TimedRenders, measure_rung, time_renders, track_drive
from rfedge.evaluate.ladder.rows import LadderRow, TrackingRow, front_table
from rfedge.evaluate.runner import Run, program_version
from rfedge.jobs import CellKey
from rfedge.results import rows_of

RungRow = Mapping[str, Any]
CRFS = (23.0, 28.0, 33.0)
EFFORTS = ("default", "thorough", "fast")
REFERENCES = (3, 1, 0)
SAMPLES = (None, 32, 8)


def rungs_for(kind: str, *, quick: bool) -> list[Rung]:
    """Return the rungs to measure with a field of ``kind``, the full one first."""
    if kind == SPLATS:
        return _splat_rungs(quick)
    if kind == NGP:
        samples = (None, 8) if quick else SAMPLES
        return [
            Rung(Quality(samples_per_ray=n, scale=scale), effort="fast")
            for n in samples
            for scale in ((0.5,) if quick else (1.0, 0.5))
        ]
    raise InvalidInput("field.kind", f"{kind!r} has no ladder")


def _splat_rungs(quick: bool) -> list[Rung]:
    details = (1.0, 0.25) if quick else DETAILS
    efforts = ("default", "fast") if quick else EFFORTS
    grid = [
        Rung(Quality(detail), references, effort=effort)
        for detail in details
        for references in REFERENCES[:: 2 if quick else 1]
        for effort in efforts
    ]
    if quick:
        return grid
    one_knob = [
        Rung(Quality(sh_degree=1)),
        Rung(Quality(sh_degree=0)),
        Rung(Quality(scale=0.5)),
        Rung(references=4),
        Rung(references=4, effort="thorough"),
        Rung(references=2),
        Rung(photometric=False),
        Rung(references=2, effort="fast"),
    ]
    low = [
        Rung(Quality(0.5, 1), 1, photometric=False, effort="fast"),
        Rung(Quality(0.25, 0), 1, photometric=False, effort="fast"),
    ]
    return grid + one_knob + low


def rate_percents(curves: Sequence[Sequence[RungRow]]) -> list[float]:
    """Return for each curve (one rung's rows over CRFs) its bits at equal quality, in percent more
    than the first curve's: the mean over the qualities both reach, log(bits) linear in dB.

    Raises ``InvalidInput`` for curves that share no quality.
    """
    return [_rate_percent(curves[0], curve) for curve in curves]


def _rate_percent(base: Sequence[RungRow], other: Sequence[RungRow]) -> float:
    ours, theirs = _curve(base), _curve(other)
    low, high = max(ours[0][0], theirs[0][0]), min(ours[0][-1], theirs[0][-1])
    if not low < high:
        raise InvalidInput(
            "ladder",
            f"{other[0]['rung']} reaches {theirs[0][0]:.1f}..{theirs[0][-1]:.1f} dB, the first "
            f"rung {ours[0][0]:.1f}..{ours[0][-1]:.1f} dB; take CRFs further apart",
        )
    grid = np.linspace(low, high, 33)
    difference = np.interp(grid, *theirs) - np.interp(grid, *ours)
    return float(100 * np.expm1(difference.mean()))


def _curve(rows: Sequence[RungRow]) -> tuple[list[float], list[float]]:
    points = sorted((row["psnr_db"], float(np.log(row["bits_per_frame"]))) for row in rows)
    return [db for db, _ in points], [log_bits for _, log_bits in points]


def fronts(rows: Sequence[RungRow]) -> list[bool]:
    """Return of each row whether it is on the front: no other row at its CRF takes less of the
    sender's time without more bits at equal quality, or fewer bits without more time."""
    return [not any(_beats(other, row) for other in rows) for row in rows]


def _beats(other: RungRow, row: RungRow) -> bool:
    if other["settings"]["crf"] != row["settings"]["crf"]:
        return False
    a = (other["sender_ms"], other["rate_percent"])
    b = (row["sender_ms"], row["rate_percent"])
    return a[0] <= b[0] and a[1] <= b[1] and a != b


PROBE_FRAMES = LEAST_FRAMES
NOMINAL_RATE_HZ = 10.0
"""Rate that the drive is named with; bits and times of a rung do not depend on it."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Contender:
    """One field with the rungs it is measured on, and its drive's renders, made when needed."""

    field: RadianceField
    drive: Drive
    program: str
    quick: bool

    @cached_property
    def rungs(self) -> list[Rung]:
        """The rungs of this kind of field."""
        return rungs_for(self.field.metadata.kind, quick=self.quick)

    @cached_property
    def _kept(self) -> dict[Quality, TimedRenders]:
        return {}

    def rendered(self, quality: Quality) -> TimedRenders:
        """Return the drive rendered at ``quality``; the last one asked for is kept."""
        if quality not in self._kept:
            self._kept.clear()
            self._kept[quality] = time_renders(self.field, self.drive, quality)
        return self._kept[quality]

    def key(self, rung: Rung, crf: float) -> CellKey:
        """Return the key of a rung at a CRF."""
        return {
            "verb": "ladder",
            "field": self.field.field_id,
            "frames": self.drive.digest,
            "rung": rung.name,
            "crf": crf,
            "program": self.program,
        }

    def _settings(self, quality: Quality) -> dict[str, Any]:
        return {
            "kind": self.field.metadata.kind,
            "detail": quality.detail,
            "sh_degree": quality.sh_degree,
            "samples_per_ray": quality.samples_per_ray,
            "scale": quality.scale,
        }

    def measured(self, rung: Rung, crf: float) -> Row:
        """Return the row of a rung at a CRF, without what depends on other rungs."""
        quality = rung.quality
        return {
            "rung": f"{self.field.metadata.kind} {rung.name} crf{crf:g}",
            "settings": {
                **self._settings(quality),
                "references": rung.references,
                "photometric": rung.photometric,
                "effort": rung.effort,
                "crf": crf,
            },
            **measure_rung(self.drive, self.rendered(quality), rung, crf),
        }

    def tracked(self, rung: Rung, tracking: TrackingEffort, placed: Sequence[RungRow]) -> Row:
        """Return the row of an effort of tracking at a rung's quality; ``placed``: the rung's rows
        at the dataset's poses."""
        quality = rung.quality
        row = {"settings": self._settings(quality), "tracking": str(tracking)}
        found = track_drive(self.field, self.drive, quality, tracking)
        if found is None:
            return row
        seen = replace(self.rendered(quality), views=found.views)
        tracked = [
            {"rung": "tracked", **measure_rung(self.drive, seen, rung, row["settings"]["crf"])}
            for row in placed
        ]
        more_percent = rate_percents([placed, tracked])[1]
        return {
            **row,
            "track_ms": found.track_ms,
            "renders": found.renders,
            "rate_percent": more_percent,
        }


def run_ladder(job: EvalLadder, console: Console) -> dict[str, Any]:
    """Measure what is not measured yet, write the result and print the front.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is measured if an input is wrong.
    """
    name = DriveName(job.drive.stem, NOMINAL_RATE_HZ, job.drive)
    drive = read_drive(name, ONE_RUN if job.quick else job.frames)
    run = Run.begin("ladder", job, job.fields, console)
    contenders = [
        Contender(open_field(path), drive, program_version(), job.quick) for path in job.fields
    ]
    _say_cost(contenders, run)
    curves = [
        [_row(contender, rung, crf, run) for crf in CRFS]
        for contender in contenders
        for rung in contender.rungs
    ]
    rows = _judged(curves)
    measured = [(c, rung) for c in contenders for rung in c.rungs]
    tracking = _tracking(list(zip(measured, curves, strict=True)), run)
    content = {
        "threads": 1,
        "size_px": drive.frames[0].size_px,
        "fields": [
            {
                "kind": c.field.metadata.kind,
                "field_id": c.field.field_id,
                "primitives": c.field.primitives,
                "held_out_psnr_db": c.field.metadata.held_out_psnr_db,
            }
            for c in contenders
        ],
        "frames": {"drive": str(job.drive), "count": len(drive.frames), "sha256": drive.digest},
        "rows": rows,
        "tracking": tracking,
    }
    return run.finish(content, front_table)


def _judged(curves: Sequence[Sequence[Row]]) -> list[LadderRow]:
    """Add to every row its rate against the ladder's first rung, and whether it is on the front."""
    rates = rate_percents(curves)
    rows = [
        {**row, "rate_percent": rate}
        for curve, rate in zip(curves, rates, strict=True)
        for row in curve
    ]
    on_front = zip(rows, fronts(rows), strict=True)
    return rows_of(LadderRow, [{**row, "on_front": on} for row, on in on_front])


def _row(contender: Contender, rung: Rung, crf: float, run: Run) -> Row:
    def make() -> list[Row]:
        row = contender.measured(rung, crf)
        run.tell(
            f"  {row['rung']}: {row['sender_ms']:.0f} ms, {row['bits_per_frame'] / 1e3:.0f} kbit, "
            f"{row['psnr_db']:.2f} dB"
        )
        return [row]

    (row,) = run.store.rows(contender.key(rung, crf), make)
    return row


def _tracking(
    measured: Sequence[tuple[tuple[Contender, Rung], Sequence[Row]]],
    run: Run,
) -> list[TrackingRow]:
    """Measure every effort at each quality of each field, coded as its first rung is."""
    first: dict[tuple[str, Quality], tuple[Contender, Rung, Sequence[Row]]] = {}
    for (contender, rung), rows in measured:
        first.setdefault((contender.field.field_id, rung.quality), (contender, rung, rows))
    return rows_of(
        TrackingRow,
        [
            _tracking_row(*given, tracking, run)
            for given in first.values()
            for tracking in TrackingEffort
        ],
    )


def _tracking_row(
    contender: Contender,
    rung: Rung,
    placed: Sequence[Row],
    tracking: TrackingEffort,
    run: Run,
) -> Row:
    def make() -> list[Row]:
        row = contender.tracked(rung, tracking, placed)
        took = "lost" if row.get("track_ms") is None else f"{row['track_ms']:.1f} ms"
        kind, quality = contender.field.metadata.kind, quality_name(rung.quality)
        run.tell(f"  {kind} {quality} track-{tracking}: {took}")
        return [row]

    name = replace(rung, tracking=tracking).name
    key = {**contender.key(rung, 0.0), "verb": "ladder-tracking", "rung": f"{name} {tracking}"}
    (row,) = run.store.rows(key, make)
    return row


def _say_cost(contenders: Sequence[Contender], run: Run) -> None:
    """Time the full rung of each field on a few frames."""
    cells, left, seconds = 0, 0, 0.0
    for contender in contenders:
        keys = [contender.key(rung, crf) for rung in contender.rungs for crf in CRFS]
        missing = sum(not run.store.has(key) for key in keys)
        cells, left = cells + len(keys), left + missing
        if missing:
            probe = contender.drive.first(PROBE_FRAMES)
            began_s = monotonic()
            first = contender.rungs[0]
            rendered = time_renders(contender.field, probe, first.quality)
            rendered_s = monotonic()
            measure_rung(probe, rendered, first, CRFS[1])
            per_frame = len(contender.drive.frames) / PROBE_FRAMES
            qualities = len({rung.quality for rung in contender.rungs})
            seconds += per_frame * qualities * (rendered_s - began_s)
            seconds += per_frame * missing * (monotonic() - rendered_s)
    run.tell(f"{cells} rungs to measure, {left} of them left: at most {seconds / 60:.1f} min")
