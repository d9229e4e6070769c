"""Measure a ladder: fields and a drive in, ``ladder.json`` out, the cost said before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from rfcore.codec.ladder import Rung
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.field.quality import Quality
from rfedge.evaluate.cells import CellKey, CellStore
from rfedge.evaluate.ladder import LadderClip, Rendered, measure_rung, render_clip
from rfedge.evaluate.ladder_rungs import CRFS, fronts, rate_percents, rungs_for
from rfedge.evaluate.result_file import check_result_path, provenance, write_result
from rfedge.provenance import revision

__all__ = ["LadderJob", "run_ladder"]

QUICK_FRAMES = 4
PROBE_FRAMES = 3
Row = dict[str, Any]


@dataclass(frozen=True)
class LadderJob:
    """What to measure; see ``rfedge eval ladder --help``."""

    fields: Sequence[Path]
    drive: Path
    out: Path
    cells: Path
    frames: int
    quick: bool = False

    def __post_init__(self) -> None:
        if not self.fields:
            raise InvalidInput("fields", "name at least one field")
        check_result_path(self.out)
        if self.frames < PROBE_FRAMES:
            raise InvalidInput("frames", f"{self.frames} must be at least {PROBE_FRAMES}")


@dataclass(frozen=True)
class Contender:
    """One field with the rungs it is measured on, and its clip's renders as they are needed."""

    field: RadianceField
    clip: LadderClip
    revision: str
    quick: bool

    @cached_property
    def rungs(self) -> list[Rung]:
        """The rungs of this kind of field."""
        return rungs_for(self.field.metadata.kind, quick=self.quick)

    @cached_property
    def _seen(self) -> dict[Quality, Rendered]:
        return {}

    def seen(self, quality: Quality) -> Rendered:
        """Return the clip rendered at ``quality``; the last one asked for is kept."""
        if quality not in self._seen:
            self._seen.clear()
            self._seen[quality] = render_clip(self.field, self.clip, quality)
        return self._seen[quality]

    def key(self, rung: Rung, crf: float) -> CellKey:
        """Name the cell of a rung at a CRF."""
        return {
            "verb": "ladder",
            "field": self.field.field_id,
            "frames": self.clip.digest,
            "rung": rung.name,
            "crf": crf,
            "revision": self.revision,
        }

    def measured(self, rung: Rung, crf: float) -> Row:
        """Return the row of a rung at a CRF, but for what takes the others to say."""
        quality, kind = rung.quality, self.field.metadata.kind
        return {
            "rung": f"{kind} {rung.name} crf{crf:g}",
            "settings": {
                "kind": kind,
                "detail": quality.detail,
                "sh_degree": quality.sh_degree,
                "samples_per_ray": quality.samples_per_ray,
                "scale": quality.scale,
                "references": rung.references,
                "photometric": rung.photometric,
                "preset": rung.preset,
                "rough": rung.rough,
                "crf": crf,
            },
            **measure_rung(self.clip, self.seen(quality), rung, crf),
        }


def run_ladder(job: LadderJob, console: Console) -> Row:
    """Measure what is not measured yet, write ``job.out``, and return its content.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is measured if an input is wrong.
    """
    dataset = read_dataset(job.drive)
    clip = LadderClip.of(dataset, QUICK_FRAMES if job.quick else job.frames)
    at = revision()
    contenders = [Contender(load_field(path), clip, at, job.quick) for path in job.fields]
    store = CellStore(job.cells)
    _say_cost(contenders, store, console)
    curves = [
        [_row(contender, rung, crf, store, console) for crf in CRFS]
        for contender in contenders
        for rung in contender.rungs
    ]
    rows = _judged(curves)
    result = {
        "case": "ladder",
        **provenance(at),
        "quick": job.quick,
        "threads": 1,
        "size_px": list(clip.frames[0].size_px),
        "fields": [
            {
                "kind": c.field.metadata.kind,
                "field_id": c.field.field_id,
                "primitives": c.field.primitives,
                "held_out_psnr_db": c.field.metadata.held_out_psnr_db,
            }
            for c in contenders
        ],
        "frames": {"drive": str(job.drive), "count": len(clip.frames), "sha256": clip.digest},
        "rows": rows,
    }
    write_result(job.out, result)
    return result


def _judged(curves: Sequence[Sequence[Row]]) -> list[Row]:
    """Add to every row what only the whole ladder can say: rate against its first rung, front."""
    rates = rate_percents(curves)
    rows = [
        {**row, "rate_percent": rate}
        for curve, rate in zip(curves, rates, strict=True)
        for row in curve
    ]
    return [{**row, "on_front": on} for row, on in zip(rows, fronts(rows), strict=True)]


def _row(contender: Contender, rung: Rung, crf: float, store: CellStore, console: Console) -> Row:
    def make() -> list[Row]:
        row = contender.measured(rung, crf)
        console.print(
            f"  {row['rung']}: {row['sender_ms']:.0f} ms, {row['bits_per_frame'] / 1e3:.0f} kbit, "
            f"{row['psnr_db']:.2f} dB"
        )
        return [row]

    (row,) = store.rows(contender.key(rung, crf), make)
    return row


def _say_cost(contenders: Sequence[Contender], store: CellStore, console: Console) -> None:
    """Time the full rung of each field on a few frames."""
    cells, left, seconds = 0, 0, 0.0
    for contender in contenders:
        keys = [contender.key(rung, crf) for rung in contender.rungs for crf in CRFS]
        missing = sum(not store.has(key) for key in keys)
        cells, left = cells + len(keys), left + missing
        if missing:
            probe = _shortened(contender.clip)
            began_s = monotonic()
            first = contender.rungs[0]
            seen = render_clip(contender.field, probe, first.quality)
            rendered_s = monotonic()
            measure_rung(probe, seen, first, CRFS[1])
            per_frame = len(contender.clip.frames) / PROBE_FRAMES
            qualities = len({rung.quality for rung in contender.rungs})
            seconds += per_frame * qualities * (rendered_s - began_s)
            seconds += per_frame * missing * (monotonic() - rendered_s)
    console.print(f"{cells} rungs to measure, {left} of them left: at most {seconds / 60:.1f} min")


def _shortened(clip: LadderClip) -> LadderClip:
    return LadderClip(
        clip.cameras[:PROBE_FRAMES], clip.pictures[:PROBE_FRAMES], clip.frames[:PROBE_FRAMES]
    )
