"""Run a comparison: drives and a field in, one result file out, the cost said before it starts."""

from __future__ import annotations

import hashlib
import importlib
import json
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console
from rich.table import Table

from rfcore.codec.references import RENDER_ONLY
from rfcore.dataset import Dataset, read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.files import write_whole
from rfcore.native.yuv import i420_from_rgb
from rfcore.train import mean_psnr_db
from rfedge.evaluate.cells import CellStore
from rfedge.evaluate.clip import ClipCoder
from rfedge.evaluate.compare import BEST, Contest, Performance, compare_rows, perform
from rfedge.evaluate.own import FieldCoder, see_clip
from rfedge.evaluate.rivals import svtav1_lowdelay, x264_lowdelay, x265_lowdelay
from rfedge.provenance import host, revision

__all__ = ["CompareJob", "DriveName", "foreign_coder", "rival_families", "run_compare"]

QUICK_FRAMES = 8
PROBE_FRAMES = 2
Row = dict[str, Any]


@dataclass(frozen=True)
class CompareJob:
    """What to compare; see ``rfedge eval compare --help``."""

    field: Path
    drives: Sequence[str]
    preset: str
    out: Path
    cells: Path
    methods: Sequence[str] = ()
    quick: bool = False

    def __post_init__(self) -> None:
        if self.out.suffix != ".json":
            raise InvalidInput("out", f"{self.out} must end in .json")


@dataclass(frozen=True)
class DriveName:
    """A drive as it is named on the command line: ``NAME@HZ=DATASET``."""

    scene: str
    rate_hz: float
    dataset: Path

    @staticmethod
    def parse(text: str) -> DriveName:
        """Raise ``InvalidInput`` for text of another form."""
        found = re.fullmatch(r"([\w.-]+)@(\d+(?:\.\d+)?)=(.+)", text)
        if not found or float(found[2]) <= 0:
            raise InvalidInput("drives", f"{text!r} is not NAME@HZ=DATASET, as empty@10=drive.json")
        return DriveName(found[1], float(found[2]), Path(found[3]))


@dataclass(frozen=True)
class Bout:
    """One drive with everybody who codes it."""

    contest: Contest
    methods: Sequence[ClipCoder]
    families: Mapping[str, Sequence[ClipCoder]]

    @property
    def coders(self) -> list[ClipCoder]:
        """All of them, ours first."""
        return [*self.methods, *(coder for family in self.families.values() for coder in family)]


def run_compare(job: CompareJob, console: Console) -> dict[str, Any]:
    """Code every drive with every coder, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    names = [DriveName.parse(text) for text in job.drives]
    field = load_field(job.field)
    bouts = [_bout(job, name, field) for name in names]
    store = CellStore(job.cells)
    left_s = sum(_seconds_left(bout, store) for bout in bouts)
    cells = sum(len(coder.points) for bout in bouts for coder in bout.coders)
    console.print(f"{cells} clips to code, about {left_s / 60:.1f} minutes of them left to do")
    rows = [row for bout in bouts for row in _rows(bout, store, console)]
    result = {
        "case": "compare",
        "command": shlex.join(["rfedge", *sys.argv[1:]]),
        "host": host(),
        "revision": revision(),
        "quick": job.quick,
        "field_id": field.field_id,
        "frames": {f"{b.contest.scene}@{b.contest.rate_hz:g}": _frames(b) for b in bouts},
        "rows": rows,
    }
    job.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(job.out, json.dumps(result, indent=1) + "\n")
    _print(rows, console)
    return result


def rival_families(preset: str, *, quick: bool) -> dict[str, list[ClipCoder]]:
    """Return the rivals by codec: the anchor alone of its kind, the others at several settings."""
    x264 = [x264_lowdelay(p) for p in ("medium", "slower", "veryslow") if not quick]
    refresh = x264_lowdelay(
        preset, f"x264-intra-refresh-{preset}", **{"intra-refresh": "1", "keyint": "30"}
    )
    families: dict[str, list[ClipCoder]] = {
        "x264-lowdelay": [x264_lowdelay(preset)],
        "x264-stronger": list(x264),
        "x264-intra-refresh": [] if quick else [refresh],
        "x265-lowdelay": [] if quick else [x265_lowdelay(p) for p in ("veryfast", "medium")],
        "svtav1-lowdelay": [svtav1_lowdelay(p) for p in ((8,) if quick else (10, 8, 6, 4))],
    }
    return {name: family for name, family in families.items() if family}


def foreign_coder(text: str) -> ClipCoder:
    """Return an instance of ``package.module:Class``; raise ``InvalidInput`` if there is none."""
    module, _, name = text.partition(":")
    try:
        coder: ClipCoder = getattr(importlib.import_module(module), name)()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InvalidInput("method", f"{text!r} is no package.module:Class ({error})") from error
    missing = [key for key in ("name", "points", "version", "code") if not hasattr(coder, key)]
    if missing:
        raise InvalidInput("method", f"{text!r} lacks {', '.join(missing)} of a ClipCoder")
    return coder


def _bout(job: CompareJob, name: DriveName, field: RadianceField) -> Bout:
    dataset = read_dataset(name.dataset)
    pictures = dataset.pictures[: QUICK_FRAMES if job.quick else None]
    frames = [i420_from_rgb(picture.read()) for picture in pictures]
    digest = hashlib.sha256(b"".join(frame.digest() for frame in frames)).hexdigest()
    quality_db = mean_psnr_db(field, pictures)
    contest = Contest(name.scene, name.rate_hz, frames, digest, quality_db)
    families = rival_families(job.preset, quick=job.quick)
    families |= {coder.name: [coder] for coder in map(foreign_coder, job.methods)}
    return Bout(contest, _own(job, field, dataset, len(frames)), families)


def _own(job: CompareJob, field: RadianceField, dataset: Dataset, count: int) -> list[ClipCoder]:
    seen = see_clip(field, [picture.camera for picture in dataset.pictures[:count]])
    mark = f"{job.preset}-{field.field_id[:12]}"
    ours = FieldCoder(seen, f"rfedge-{mark}", revision(), preset=job.preset)
    plain = FieldCoder(
        seen,
        f"rfedge-render-only-{mark}",
        revision(),
        preset=job.preset,
        references=RENDER_ONLY,
    )
    return [ours, plain]


def _seconds_left(bout: Bout, store: CellStore) -> float:
    """Time two frames of each coder that still has something to do."""
    contest, total_s = bout.contest, 0.0
    for coder in bout.coders:
        left = sum(not store.has(contest.cell_key(coder, p)) for p in coder.points)
        if left:
            began_s = monotonic()
            middle = coder.points[len(coder.points) // 2]
            coder.code(contest.frames[:PROBE_FRAMES], contest.rate_hz, middle)
            total_s += left * (monotonic() - began_s) * len(contest.frames) / PROBE_FRAMES
    return total_s


def _rows(bout: Bout, store: CellStore, console: Console) -> list[Row]:
    def performed(coder: ClipCoder) -> Performance:
        console.print(f"  {bout.contest.scene} {bout.contest.rate_hz:g} Hz: {coder.name}")
        return perform(bout.contest, coder, store)

    families = {n: [performed(c) for c in family] for n, family in bout.families.items()}
    methods = [performed(coder) for coder in bout.methods]
    return [row for method in methods for row in compare_rows(bout.contest, method, families)]


def _frames(bout: Bout) -> dict[str, Any]:
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
