"""Measure that no field makes a stream worse than plain x264: the right one, a wrong one, none.

At 31, 33 and 35 dB a frame may cost at most 2 % more than x264 with low delay, without its header.
Two controls make the field useless: ``wrong-street`` is the field seen a quarter turn to the left,
depth and picture alike, and ``black`` is a black picture at depth 0. Both ends predict from them;
the sender must notice by itself that they are of no use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rich.console import Console

from rfcore.camera import Camera, Pose
from rfcore.field import RadianceField
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.arguments import open_field
from rfedge.evaluate.clips import DECIMATION, QUICK, Clip, ClipCoder, Drive, DriveName, read_drive
from rfedge.evaluate.field_coder import FieldCoder, RenderedClip, render_clip
from rfedge.evaluate.never_worse import EvalNeverWorse
from rfedge.evaluate.performance import Performance, perform, seconds_left
from rfedge.evaluate.rivals import x264_for_psnr, x264_lowdelay
from rfedge.evaluate.runner import Run, program_version
from rfedge.jobs import CellStore
from rfedge.report.tables import Column, Table, columns, shown
from rfedge.results import Result, rows_of

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
    """One drive with one field, right or wrong, at one quality.

    Bytes are means over all frames but the first, of whole messages with their header. Processor
    times are the sender's, a frame.
    """

    scene: str
    hz: float
    frames: int
    """Frames of the drive."""
    control: str = field(metadata=shown("field"))
    """The field that both ends hold."""
    preset: str
    """Preset of x264, the rival."""
    at_db: float = field(metadata=shown("dB", "g"))
    bytes: float = field(metadata=shown("bytes", ".0f"))
    header_bytes: float = field(metadata=shown("header bytes", ".0f"))
    rival_bytes: float = field(metadata=shown("x264 bytes", ".0f"))
    excess_percent: float = field(metadata=shown("excess %", "+.1f"))
    """Bytes without the header above those of x264 at the same quality."""
    excess_percent_psnr_tuned: float = field(metadata=shown("over x264 tuned for PSNR, %", "+.1f"))
    """The same against x264 tuned for PSNR."""
    holds: bool
    """Whether ``excess_percent`` is within its limit."""
    first_frame_bytes: int
    """Bytes of the first frame at this quality."""
    rival_first_frame_bytes: int
    references: str = field(metadata=shown("mostly predicted from"))
    """The picture that most frames were predicted from."""
    cpu_ms: float
    rival_cpu_ms: float


def controls_of(field: RadianceField, drive: Drive) -> Mapping[str, RenderedClip]:
    """Return what both ends render along ``drive``, by the names in ``CONTROLS``."""
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
    """One drive under all controls; ``program`` is the version of the code."""

    drive: Drive
    rendered: Mapping[str, RenderedClip]
    effort: str
    preset: str
    program: str

    @property
    def clip(self) -> Clip:
        """The clip that every coder gets, without the field's own quality."""
        return self.drive.clip()

    @property
    def coders(self) -> dict[str, ClipCoder]:
        """Our coder under each control, then the anchors."""
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


def run_never_worse(job: EvalNeverWorse, console: Console) -> dict[str, Any]:
    """Code what is not there yet, write the result and print its rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong.
    """
    for text in (*job.drives, *job.decimated):
        DriveName.parse(text)
    run, field = Run.begin("never-worse", job, [job.field], console), open_field(job.field)
    drives = [
        NeverWorse(drive, controls_of(field, drive), job.effort, job.preset, program_version())
        for drive in _drives(job, field)
    ]
    left_s = sum(seconds_left(each.clip, each.coders.values(), run.store) for each in drives)
    run.tell(f"{len(drives)} drives, about {left_s / 60:.1f} minutes left to do")
    rows = [row for each in drives for row in each.rows(run.store, retime=job.retime)]
    frames = {f"{d.drive.name.scene}@{d.drive.name.rate_hz:g}": d.drive.digest for d in drives}
    content = {"field_id": field.field_id, "frames": frames, "rows": rows}
    return run.finish(content, never_worse_parts)


def _drives(job: EvalNeverWorse, field: RadianceField) -> list[Drive]:
    named, limit = (field, job.field), QUICK if job.quick else None
    slow = [read_drive(text, None, named).every(DECIMATION) for text in job.decimated]
    if job.quick:
        slow = [drive.spread(QUICK) for drive in slow]
    return [*slow, *(read_drive(text, limit, named) for text in job.drives)]


DRIVE = Column("drive", lambda row: f"{row.scene}, {row.hz:g} Hz")
HOLDS = Column("at most 2 %", lambda row: "yes" if row.holds else "NO")
CPU = Column(
    "sender ms: ours / x264", lambda row: (row.cpu_ms, row.rival_cpu_ms), "{:.0f} / {:.0f}"
)


def never_worse_parts(result: Result) -> Iterator[Table | str]:
    """Yield the verdict on each field at each quality, then the bytes and times behind it."""
    rows = rows_of(NeverWorseRow, result["rows"])
    verdict = ("excess_percent", HOLDS, "excess_percent_psnr_tuned", "references")
    yield Table(
        "Bytes above those of x264 without the header",
        columns(NeverWorseRow, DRIVE, "control", "at_db", *verdict),
        rows,
    )
    sizes = ("bytes", "header_bytes", "rival_bytes", CPU)
    yield Table("A frame", columns(NeverWorseRow, DRIVE, "control", "at_db", *sizes), rows)
