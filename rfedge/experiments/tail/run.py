"""Code many different frames, ours and x264's, piece by piece; one result of what came out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.codec.h264.config import check_effort
from rfcore.errors import InvalidInput
from rfedge.experiments.cells import CellKey, CellStore, Rows, program_version
from rfedge.experiments.clips import STEADY, Clip, ClipCoder, psnr_of_mse
from rfedge.experiments.field_coder import FieldCoder, render_clip
from rfedge.experiments.latency.run import BUDGETS_MS, at_quality, needed_rate_bps
from rfedge.experiments.rivals import x264_lowdelay
from rfedge.experiments.tail.report import QUANTILES, TailRow
from rfedge.experiments.tail.street import FieldStreet, StreetDrive
from rfedge.results import check_result_path, make_result, provenance, write_result

__all__ = ["TailJob", "run_tail"]

DRIVES_A_PIECE = 50
CONFIDENCE = 0.95
METHODS = ("ours", "x264")


@dataclass(frozen=True)
class TailJob:
    """What to code; see ``rfedge eval tail --help``."""

    street: FieldStreet
    frames: int
    quality_db: float
    effort: str
    preset: str
    processes: int
    out: Path
    cells: Path

    def __post_init__(self) -> None:
        check_result_path(self.out)
        check_effort("effort", self.effort)
        if not 1 <= self.frames <= 10_000_000:
            raise InvalidInput("frames", f"{self.frames:,} is outside 1..10,000,000")
        if not 1 <= self.processes <= 256:
            raise InvalidInput("processes", f"{self.processes} is outside 1..256")
        if not 20 <= self.quality_db <= 50:
            raise InvalidInput("quality_db", f"{self.quality_db} dB is outside 20..50 dB")


@dataclass(frozen=True)
class Piece:
    """Some drives of a street, coded by both methods at fixed CRFs."""

    street: FieldStreet
    first: int
    effort: str
    preset: str
    crfs: tuple[float, float]

    def key(self) -> CellKey:
        """Name the piece's cell."""
        street = self.street
        width_px, height_px = street.size_px
        return {
            "verb": "tail",
            "field": street.opened.field_id,
            "path": repr([camera.world_from_cam for camera in street.recorded]),
            "width_px": width_px,
            "height_px": height_px,
            "hz": street.rate_hz,
            "detail": street.detail,
            "noise": street.noise_sigma,
            "seed": street.seed,
            "first": self.first,
            "drives": DRIVES_A_PIECE,
            "effort": self.effort,
            "preset": self.preset,
            "crf": self.crfs[0],
            "rival_crf": self.crfs[1],
            "program": program_version(),
        }

    def rows(self) -> Rows:
        """Code it: a row a method, of sizes in bytes and squared errors."""
        sizes: dict[str, list[int]] = {name: [] for name in METHODS}
        errors: dict[str, list[float]] = {name: [] for name in METHODS}
        for number in range(self.first, self.first + DRIVES_A_PIECE):
            drive = self.street.drive(number)
            coders = _coders(self.street, drive, self.effort, self.preset)
            for name, coder, crf in zip(METHODS, coders, self.crfs, strict=True):
                coded = coder.code(drive.frames, self.street.rate_hz, crf)
                sizes[name] += coded.frame_bytes[STEADY].tolist()
                errors[name] += coded.luma_mse[STEADY].tolist()
        return [
            {"method": name, "bytes": sizes[name], "mse": float(np.mean(errors[name]))}
            for name in METHODS
        ]


@dataclass
class Gathered:
    """What all pieces made of one method."""

    sizes: list[int] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)


def run_tail(job: TailJob, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write ``job.out``, and return its content.

    Raises ``InvalidInput``, ``DatasetError`` or ``FieldFormatError`` before anything is coded if an
    input is wrong.
    """
    street, store = job.street, CellStore(job.cells)
    made = provenance([street.field, street.path])
    crfs = _crfs(job, store)
    unopened = replace(street)  # goes to other processes, which open it themselves
    pieces = [Piece(unopened, first, job.effort, job.preset, crfs) for first in _firsts(job)]
    console.print(f"{len(pieces)} pieces of {DRIVES_A_PIECE} drives, CRF {crfs[0]:g}, {crfs[1]:g}")
    gathered = {name: Gathered() for name in METHODS}
    began_s = monotonic()
    for number, rows in enumerate(_done(pieces, job), 1):
        for row in rows:
            gathered[row["method"]].sizes += row["bytes"]
            gathered[row["method"]].errors.append(row["mse"])
        left_s = (monotonic() - began_s) / number * (len(pieces) - number)
        console.print(f"  {number} of {len(pieces)}, about {left_s / 60:.0f} minutes left")
    drives = len(pieces) * DRIVES_A_PIECE
    names = (f"rfedge-{job.effort}", x264_lowdelay(job.preset).name)
    content = {
        "street": {
            "field_id": street.opened.field_id,
            "path": str(street.path),
            "detail": street.detail,
            "noise": street.noise_sigma,
            "seed": street.seed,
        },
        "rows": [
            _row(street, names[k], crfs[k], gathered[method], drives)
            for k, method in enumerate(METHODS)
        ],
    }
    result = make_result("tail", made, content)
    write_result(job.out, result)
    return result


def _firsts(job: TailJob) -> Iterator[int]:
    """Yield the first drive of each piece until there are frames enough."""
    counted = first = 0
    while counted < job.frames:
        yield first
        drives = range(first, first + DRIVES_A_PIECE)
        counted += sum(job.street.frame_count(number) - 1 for number in drives)
        first = drives.stop


def _done(pieces: Sequence[Piece], job: TailJob) -> Iterator[Rows]:
    if job.processes == 1:
        yield from (_kept(piece, job.cells) for piece in pieces)
        return
    with ProcessPoolExecutor(job.processes, get_context("spawn")) as pool:
        yield from pool.map(_kept, pieces, [job.cells] * len(pieces))


def _kept(piece: Piece, cells: Path) -> Rows:
    piece = replace(piece, street=_opened(piece.street))
    return CellStore(cells).rows(piece.key(), piece.rows)


@lru_cache(maxsize=1)
def _opened(street: FieldStreet) -> FieldStreet:
    """Return an equal street, the same one each time: it reads its field once a process."""
    return street


def _crfs(job: TailJob, store: CellStore) -> tuple[float, float]:
    """Return the CRFs at which both methods code the first drive to the quality asked for."""
    drive = job.street.drive(0)
    digest = "-".join(frame.digest().hex()[:8] for frame in drive.frames)
    clip = Clip("tail", job.street.rate_hz, drive.frames, digest, None)
    coders = _coders(job.street, drive, job.effort, job.preset)
    ours, theirs = (at_quality(clip, coder, job.quality_db, store).point for coder in coders)
    return ours, theirs


def _coders(
    street: FieldStreet, drive: StreetDrive, effort: str, preset: str
) -> tuple[ClipCoder, ClipCoder]:
    rendered = render_clip(street.opened, drive.cameras, street.held)
    ours = FieldCoder(rendered, f"rfedge-{effort}", program_version(), effort=effort)
    return ours, x264_lowdelay(preset)


def _row(street: FieldStreet, method: str, crf: float, gathered: Gathered, drives: int) -> TailRow:
    sizes = np.array(gathered.sizes)
    width_px, height_px = street.size_px
    return TailRow(
        method=method,
        hz=street.rate_hz,
        width_px=width_px,
        height_px=height_px,
        crf=crf,
        psnr_db=psnr_of_mse(float(np.mean(gathered.errors))),
        frames=len(sizes),
        drives=drives,
        mean_bytes=float(sizes.mean()),
        quantile_bytes={
            share: float(np.quantile(sizes, float(share), method="higher")) for share in QUANTILES
        },
        largest_bytes=int(sizes.max()),
        uplink_bps_all_within={
            f"{ms:g}": needed_rate_bps(gathered.sizes, street.rate_hz, ms, share=1.0)
            for ms in BUDGETS_MS
        },
        late_share_below=1 - (1 - CONFIDENCE) ** (1 / len(sizes)),
    )
