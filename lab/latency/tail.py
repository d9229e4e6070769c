"""Many different frames, ours and x264's, coded piece by piece: how their sizes are distributed.

A field is the street itself: what a camera sees is its render with noise, and both ends hold a
lower level of its detail. A drive follows the cameras of a data set from its first to its last at a
speed of its own, in a lane of its own, with a sway that changes along the way. No two drives show
the same pictures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lab.latency.run import BUDGETS_MS, at_quality, needed_rate_bps
from rfcore.camera import Camera, Pose
from rfcore.codec.h264.config import check_effort
from rfcore.dataset import read_dataset
from rfcore.errors import InvalidInput
from rfcore.field import Quality, RadianceField, load_field
from rfcore.image import I420
from rfcore.motion import interpolated, quaternion_from_vector
from rfcore.native.yuv import i420_from_colour
from rfedge.evaluate.cells import (
    CellKey,
    CellStore,
    Rows,
    check_processes,
    each_done,
    program_version,
)
from rfedge.evaluate.clips import (
    MAX_NOISE_SIGMA,
    STEADY,
    Clip,
    ClipCoder,
    frames_digest,
    psnr_of_mse,
    with_noise,
)
from rfedge.evaluate.field_coder import FieldCoder, render_clip
from rfedge.evaluate.rivals import x264_lowdelay
from rfedge.report.tables import heading, print_table, table
from rfedge.results import Result, check_result_path, make_result, provenance, rows_of, write_result

__all__ = [
    "FieldStreet",
    "StreetDrive",
    "TailJob",
    "TailRow",
    "print_tail",
    "run_tail",
    "tail_section",
]


SPEED_MPS = (4.0, 14.0)
LANE_M = 0.5
"""At most so far to either side of the recorded path."""
SWAY_M, SWAY_DEG = 0.05, 1.0
"""Of each axis, up and down over ``SWAY_S``."""
SWAY_S = (0.8, 4.0)
LEAST_FRAMES = 2


@dataclass(frozen=True)
class StreetDrive:
    """One drive: what the camera saw, and from where."""

    cameras: Sequence[Camera]
    frames: Sequence[I420]


@dataclass(frozen=True)
class FieldStreet:
    """The field ``field`` as a street, along the poses of the data set ``path``.

    ``detail``: of the level that both ends hold of it. Raises ``InvalidInput`` for a value out of
    range, and for a path of one place.
    """

    field: Path
    path: Path
    size_px: tuple[int, int]
    rate_hz: float
    detail: float
    noise_sigma: float
    seed: int

    def __post_init__(self) -> None:
        if not 0.1 <= self.rate_hz <= 120:
            raise InvalidInput("hz", f"{self.rate_hz:g} is outside 0.1..120")
        if not 0 <= self.noise_sigma <= MAX_NOISE_SIGMA:
            raise InvalidInput("noise", f"{self.noise_sigma:g} is outside 0..{MAX_NOISE_SIGMA:g}")
        if any(side % 2 for side in self.size_px):
            raise InvalidInput("size", f"{self.size_px} px must be even, for the rivals")
        Quality(detail=self.detail)

    @cached_property
    def opened(self) -> RadianceField:
        """The field."""
        return load_field(self.field)

    @property
    def held(self) -> Quality:
        """What both ends render."""
        return Quality(detail=self.detail)

    @cached_property
    def recorded(self) -> Sequence[Camera]:
        """The cameras that are driven along, of the size asked for."""
        origin = self.opened.metadata.tile_origin
        pictures = read_dataset(self.path, tile_origin=origin).pictures
        poses = [picture.camera.world_from_cam for picture in pictures]
        if all(pose.translation_m == poses[0].translation_m for pose in poses):
            raise InvalidInput("path", f"{self.path} has the poses of one place")
        intrinsics = pictures[0].camera.intrinsics.resized(*self.size_px)
        return [Camera(intrinsics, pose) for pose in poses]

    @cached_property
    def _reached_m(self) -> NDArray[np.float64]:
        """How far along the recorded way each camera is."""
        places = (camera.world_from_cam.translation_m for camera in self.recorded)
        return np.cumsum([0.0, *(math.dist(a, b) for a, b in pairwise(places))])

    def frame_count(self, number: int) -> int:
        """Return how many frames drive ``number`` has."""
        return self._begun(number)[0]

    def _begun(self, number: int) -> tuple[int, np.random.Generator]:
        """Return the frames of a drive, which its speed decides, and what else of it is drawn
        from."""
        random = np.random.default_rng((self.seed, number))
        seconds = self._reached_m[-1] / random.uniform(*SPEED_MPS)
        return max(LEAST_FRAMES, math.floor(seconds * self.rate_hz)), random

    def drive(self, number: int) -> StreetDrive:
        """Return drive ``number``, always the same."""
        cameras = self._cameras(number)
        frames = [i420_from_colour(self.opened.render_colour(camera)) for camera in cameras]
        return StreetDrive(cameras, with_noise(frames, self.noise_sigma, (self.seed, number)))

    def _cameras(self, number: int) -> list[Camera]:
        count, random = self._begun(number)
        lane_m = random.uniform(-LANE_M, LANE_M)
        periods_s, phases = random.uniform(*SWAY_S, 5), random.uniform(0, 2 * np.pi, 5)
        intrinsics, cameras = self.recorded[0].intrinsics, []
        for index in range(count):
            moment_s = index / self.rate_hz
            sway = np.sin(2 * np.pi * moment_s / periods_s + phases)
            x_m, y_m = (lane_m, 0.0) + SWAY_M * sway[:2]
            turn = tuple(np.deg2rad(SWAY_DEG * sway[2:]).tolist())
            step = Pose((float(x_m), float(y_m), 0.0), quaternion_from_vector(turn))
            pose = self._along(index / (count - 1)).compose(step)
            cameras.append(Camera(intrinsics, pose).rounded())
        return cameras

    def _along(self, share: float) -> Pose:
        """Return the pose after a share of the recorded way."""
        reached_m = self._reached_m
        at_m = share * reached_m[-1]
        index = min(int(np.searchsorted(reached_m, at_m, side="right")), len(reached_m) - 1) - 1
        step_m = reached_m[index + 1] - reached_m[index]
        within = (at_m - reached_m[index]) / step_m if step_m else 0.0
        first, second = (self.recorded[index + k].world_from_cam for k in range(2))
        return interpolated(first, second, min(1.0, float(within)))


QUANTILES = ("0.5", "0.99", "0.999", "0.9999", "0.99999")


@dataclass(frozen=True)
class TailRow:
    """How large one method's frames are, and what uplink carries every one of them in time."""

    method: str
    hz: float
    width_px: int
    height_px: int
    crf: float
    psnr_db: float
    frames: int
    drives: int
    mean_bytes: float
    quantile_bytes: Mapping[str, float]
    """By the share of the frames that are no larger."""
    largest_bytes: int
    uplink_bps_all_within: Mapping[str, float]
    """Lowest constant rate at which not one is late, by the budget in ms."""
    late_share_below: float
    """What may be claimed of that rate with 95 % confidence: the share of late frames is below."""


COLUMNS = (
    "method",
    "size",
    "Hz",
    "dB",
    "frames",
    "mean bytes",
    *(f"{100 * float(share):g} % <=" for share in QUANTILES),
    "largest",
    "uplink for all within 5 ms, kbit/s",
    "within 10 ms",
    "late, at most (95 %)",
)


def tail_section(path: Path, result: Result) -> str:
    """Return the table."""
    rows = [_cells(row) for row in rows_of(TailRow, result["rows"])]
    street = result["street"]
    note = (
        f"A field stands for the street: pictures of random drives along `{street['path']}`, noise "
        f"of {street['noise']:g} levels added; both ends hold {100 * street['detail']:g} % of its "
        "splats. All pictures differ. The first of each drive is left out."
    )
    return "\n\n".join([heading(path, result), note, table(COLUMNS, rows), ""])


def print_tail(console: Console, rows: Sequence[TailRow]) -> None:
    """Print the rows."""
    print_table(console, "Sizes of different frames", COLUMNS, [_cells(row) for row in rows])


def _cells(row: TailRow) -> list[str]:
    uplink = row.uplink_bps_all_within
    return [
        row.method,
        f"{row.width_px}x{row.height_px}",
        f"{row.hz:g}",
        f"{row.psnr_db:.2f}",
        f"{row.frames:,}",
        f"{row.mean_bytes:.0f}",
        *(f"{row.quantile_bytes[share]:.0f}" for share in QUANTILES),
        str(row.largest_bytes),
        *(f"{uplink[budget] / 1e3:.0f}" for budget in ("5", "10")),
        f"{100 * row.late_share_below:.4g} %",
    ]


DRIVES_A_PIECE = 50
CONFIDENCE = 0.95
METHODS = ("ours", "x264")


@dataclass(frozen=True)
class TailJob:
    """What to code; see ``rfedge-lab tail --help``."""

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
        check_processes(self.processes)
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
    kept = partial(_kept, cells=job.cells)
    for number, rows in enumerate(each_done(kept, pieces, job.processes), 1):
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
    clip = Clip("tail", job.street.rate_hz, drive.frames, frames_digest(drive.frames), None)
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
