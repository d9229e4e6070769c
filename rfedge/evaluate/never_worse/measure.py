"""Never worse than plain x264: with the right field, one of another street, and none at all.

At 31, 33 and 35 dB a frame may cost at most 2 % more than x264 with low delay,
its header apart. Two controls make the field useless: ``wrong-street`` is the field seen a quarter
turn to the left, depth and picture alike, and ``black`` is a black picture at depth 0. Both ends
predict from them; the sender must notice by itself that they are of no use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.camera import Camera, Pose
from rfcore.codec.h264.config import check_effort
from rfcore.errors import InvalidInput
from rfcore.field import RadianceField, load_field
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.evaluate.cells import CellStore, program_version
from rfedge.evaluate.clips import DECIMATION, Clip, ClipCoder, Drive, DriveName, read_drive
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip, render_clip
from rfedge.evaluate.performance import Performance, perform, seconds_left
from rfedge.evaluate.rivals import x264_for_psnr, x264_lowdelay
from rfedge.report.tables import heading, print_table, table
from rfedge.results import (
    Result,
    check_result_path,
    make_result,
    provenance,
    rows_of,
    write_result,
)

__all__ = [
    "ALLOWED_PERCENT",
    "AT_DB",
    "CONTROLS",
    "NeverWorse",
    "NeverWorseJob",
    "NeverWorseRow",
    "controls_of",
    "never_worse_section",
    "print_never_worse",
    "run_never_worse",
]


AT_DB = (31.0, 33.0, 35.0)
ALLOWED_PERCENT = 2.0
CONTROLS = ("right", "wrong-street", "black")
POINTS = (18.0, 22.0, 26.0, 30.0, 34.0, 38.0, 42.0)
"""Wide, since x264 takes a lower quantiser at the same CRF the fewer frames a second there are."""
QUARTER_TURN = Pose((0.0, 0.0, 0.0), (0.5**0.5, 0.0, -(0.5**0.5), 0.0))
"""About the camera's vertical axis."""
BLACK_YUV = (16, 128, 128)


@dataclass(frozen=True)
class NeverWorseRow:
    """One drive with one field, right or wrong, at one quality. CPU is the sender's, a frame."""

    scene: str
    hz: float
    frames: int
    control: str
    """Which field both ends hold."""
    preset: str
    at_db: float
    bytes: float
    """Of a whole message, header included, as all bytes here a mean over all frames but one."""
    header_bytes: float
    rival_bytes: float
    excess_percent: float
    """Bytes without the header over those of x264 at the same quality."""
    excess_percent_psnr_tuned: float
    """The same against x264 tuned for PSNR."""
    holds: bool
    first_frame_bytes: int
    rival_first_frame_bytes: int
    references: str
    """What most frames were predicted from."""
    cpu_ms: float
    rival_cpu_ms: float


def controls_of(field: RadianceField, drive: Drive) -> Mapping[str, RenderedClip]:
    """Return what both ends believe to see along ``drive``, by the names in ``CONTROLS``."""
    right = render_clip(field, drive.cameras)
    turned = [
        Camera(camera.intrinsics, camera.world_from_cam.compose(QUARTER_TURN))
        for camera in right.cameras
    ]
    elsewhere = render_clip(field, turned)
    moved = (
        replace(view, camera=camera)
        for camera, view in zip(right.cameras, elsewhere.views, strict=True)
    )
    wrong = replace(elsewhere, views=tuple(moved))
    return dict(zip(CONTROLS, (right, wrong, _black(right)), strict=True))


def _black(right: RenderedClip) -> RenderedClip:
    covered = tuple(np.zeros_like(mask) for mask in right.covered)
    return replace(right, views=tuple(map(_black_view, right.views)), covered=covered)


def _black_view(view: FieldView) -> FieldView:
    planes = zip(view.render.planes, BLACK_YUV, strict=True)
    nothing = np.zeros_like(view.depth)
    return FieldView(view.camera, I420(*(np.full_like(p, v) for p, v in planes)), nothing, nothing)


@dataclass(frozen=True)
class NeverWorse:
    """One drive under all controls; ``program`` names what codes."""

    drive: Drive
    rendered: Mapping[str, RenderedClip]
    effort: str
    preset: str
    program: str

    @property
    def clip(self) -> Clip:
        """What every coder gets; the field's own quality is not of interest here."""
        return self.drive.clip()

    @property
    def coders(self) -> dict[str, ClipCoder]:
        """Ours by control, then the anchors."""
        ours: dict[str, ClipCoder] = {
            control: FieldCoder(
                rendered,
                f"rfedge-{control}-{self.effort}-{rendered.field_id[:12]}",
                self.program,
                effort=self.effort,
                points=POINTS,
            )
            for control, rendered in self.rendered.items()
        }
        return ours | {
            "plain": replace(x264_lowdelay(self.preset), points=POINTS),
            "psnr": replace(x264_for_psnr(self.preset), points=POINTS),
        }

    def rows(self, store: CellStore, *, retime: bool = False) -> Iterator[NeverWorseRow]:
        """Yield a row per control and quality.

        A field that shows more than a quality before a bit is sent is taken at its lowest: it has
        no cheaper picture. Raises ``InvalidInput`` where an anchor does not reach a quality.
        """
        done = {
            name: perform(self.clip, coder, store, retime=retime)
            for name, coder in self.coders.items()
        }
        for control in self.rendered:
            for db in AT_DB:
                yield self._row(control, done[control], done["plain"], done["psnr"], db)

    def _row(
        self, control: str, ours: Performance, plain: Performance, psnr: Performance, db: float
    ) -> NeverWorseRow:
        at_db = max(db, float(ours.steady.psnr_db[0]))
        message_bytes = ours.steady.bytes_at(at_db)
        near = ours.nearest(at_db)
        header_bytes = float(
            np.mean(near.frame_bytes[1:] - np.array(near.notes["slice_bytes"])[1:])
        )
        excess = {
            name: 100 * ((message_bytes - header_bytes) / anchor.steady.bytes_at(db) - 1)
            for name, anchor in (("plain", plain), ("psnr", psnr))
        }
        modes = [str(mode) for mode in near.notes["references"][1:]]
        return NeverWorseRow(
            scene=self.drive.name.scene,
            hz=self.drive.name.rate_hz,
            frames=len(self.drive.frames),
            control=control,
            preset=self.preset,
            at_db=db,
            bytes=message_bytes,
            header_bytes=header_bytes,
            rival_bytes=plain.steady.bytes_at(db),
            excess_percent=excess["plain"],
            excess_percent_psnr_tuned=excess["psnr"],
            holds=excess["plain"] <= ALLOWED_PERCENT,
            first_frame_bytes=int(near.frame_bytes[0]),
            rival_first_frame_bytes=int(plain.nearest(at_db).frame_bytes[0]),
            references=max(set(modes), key=modes.count),
            cpu_ms=ours.cpu_ms_per_frame,
            rival_cpu_ms=plain.cpu_ms_per_frame,
        )


QUICK_FRAMES = 6


@dataclass(frozen=True)
class NeverWorseJob:
    """What to run; see ``rfedge eval never-worse --help``."""

    field: Path
    drives: Sequence[str]
    decimated: Sequence[str]
    effort: str
    preset: str
    out: Path
    cells: Path
    quick: bool = False
    retime: bool = False

    def __post_init__(self) -> None:
        check_result_path(self.out)
        check_effort("effort", self.effort)
        if not (self.drives or self.decimated):
            raise InvalidInput("drives", "there is none")


def run_never_worse(job: NeverWorseJob, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    for text in (*job.drives, *job.decimated):
        DriveName.parse(text)
    field, made = load_field(job.field), provenance([job.field])
    store = CellStore(job.cells)
    tables = [
        NeverWorse(drive, controls_of(field, drive), job.effort, job.preset, program_version())
        for drive in _drives(job)
    ]
    left_s = sum(seconds_left(table.clip, table.coders.values(), store) for table in tables)
    console.print(f"{len(tables)} drives, about {left_s / 60:.1f} minutes left to do")
    rows = [row for table in tables for row in table.rows(store, retime=job.retime)]
    frames = {f"{t.drive.name.scene}@{t.drive.name.rate_hz:g}": t.drive.digest for t in tables}
    content = {"quick": job.quick, "field_id": field.field_id, "frames": frames, "rows": rows}
    result = make_result("never-worse", made, content)
    write_result(job.out, result)
    print_never_worse(console, rows)
    return result


def _drives(job: NeverWorseJob) -> list[Drive]:
    limit = QUICK_FRAMES if job.quick else None
    slow = [read_drive(text).every(DECIMATION) for text in job.decimated]
    return [*slow, *(read_drive(text, limit) for text in job.drives)]


COLUMNS = (
    "scene",
    "Hz",
    "field",
    "dB",
    "bytes",
    "of them header",
    "x264",
    "excess without header %",
    "against x264 tuned for PSNR %",
    "at most 2 %",
    "mostly predicted from",
    "CPU ms",
    "x264's",
)

PRINTED = ("scene", "Hz", "field", "dB", "excess %", "psnr-tuned", "holds", "references")


def never_worse_section(path: Path, result: Result) -> str:
    """Return the table; a field that made it worse stands out."""
    rows = map(_cells, rows_of(NeverWorseRow, result["rows"]))
    return "\n\n".join([heading(path, result), table(COLUMNS, rows), ""])


def print_never_worse(console: Console, rows: Sequence[NeverWorseRow]) -> None:
    """Print the verdict on each field at each quality."""
    print_table(console, "A field against none", PRINTED, [_printed_cells(row) for row in rows])


def _printed_cells(row: NeverWorseRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        row.control,
        f"{row.at_db:g}",
        f"{row.excess_percent:.1f}",
        f"{row.excess_percent_psnr_tuned:.1f}",
        "yes" if row.holds else "NO",
        row.references,
    ]


def _cells(row: NeverWorseRow) -> list[str]:
    return [
        row.scene,
        f"{row.hz:g}",
        row.control,
        f"{row.at_db:g}",
        f"{row.bytes:.0f}",
        f"{row.header_bytes:.0f}",
        f"{row.rival_bytes:.0f}",
        f"{row.excess_percent:+.1f}",
        f"{row.excess_percent_psnr_tuned:+.1f}",
        "yes" if row.holds else "**no**",
        row.references,
        f"{row.cpu_ms:.0f}",
        f"{row.rival_cpu_ms:.0f}",
    ]
