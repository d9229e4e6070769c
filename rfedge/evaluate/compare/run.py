"""Run a comparison: drives and a field in, one result file out.

What it will do and what that will take is said before it starts. The ends of every curve are coded
first, so that a window that cannot be spanned ends the run before its long part.

Where the bits of a drive go, by what each macroblock of a frame shows.

A pixel shows, in this order: *off-map*, where the field has nothing; *moving*, where the camera
differs from the same drive through the empty street (parked objects count too: what is not in the
field); *entering*, where the field's surface was outside the previous view; *disoccluded*, where it
was inside but behind another surface; and *static*, all else. A macroblock is of the first kind
that covers a quarter of it.

The bits of a kind are measured with x264: by how much the frame's slice becomes shorter when its
macroblocks of that kind show exactly what reference 0 shows there, so that nothing is left to send.
Neighbouring macroblocks predict each other, so these parts do not add up to the slice; they are
scaled to its size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from rfcore.camera import Camera
from rfcore.codec.decoder import prediction_of
from rfcore.codec.h264.config import CodecConfig
from rfcore.codec.sender.encoder import DeltaEncoder, Encoded, FrameChoice
from rfcore.codec.state import EncoderState
from rfcore.image import I420
from rfcore.views import FieldView
from rfedge.evaluate.cells import CellStore, clip_key, each_done
from rfedge.evaluate.clips import ClipCoder
from rfedge.evaluate.compare.drives import (
    PAID_AGAINST,
    CompareJob,
    DriveComparison,
    read_drive_comparisons,
)
from rfedge.evaluate.compare.foreground import by_macroblock, composed, foreground_row
from rfedge.evaluate.compare.measure import (
    break_even_row,
    compare_rows,
    curve_rows,
    ssim_rows,
)
from rfedge.evaluate.compare.report import BitShareRow, print_compared
from rfedge.evaluate.field_coder import RenderedClip
from rfedge.evaluate.performance import (
    Performance,
    perform,
    seconds_left,
    spanning_points,
    time_in_turns,
)
from rfedge.evaluate.rate_curve import Window
from rfedge.jobs import Job, Tell, run_jobs
from rfedge.results import make_result, provenance, rows_of, write_result

__all__ = ["KINDS", "SplitClip", "code_on_ray", "macroblock_kinds", "run_compare", "split_rows"]


KINDS = ("static", "moving", "disoccluded", "entering", "off-map")
PRECEDENCE = ("off-map", "moving", "entering", "disoccluded")
SHARE = 0.25
NEAR_M = 0.1
RELATIVE_DEPTH, ABSOLUTE_DEPTH_M = 0.08, 0.1
"""How far two depths of one surface may differ; as in ``rfcore.native.warp``."""
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


def macroblock_kinds(
    before: FieldView, now: FieldView, covered: Mask, foreground: Mask
) -> NDArray[np.int8]:
    """Return the index into ``KINDS`` of each macroblock, [ceil(H / 16), ceil(W / 16)]."""
    u, v, depth = _in_previous_view(before.camera, now)
    height, width = now.depth.shape
    inside = (depth > NEAR_M) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    columns = np.rint(np.clip(np.nan_to_num(u), 0, width - 1)).astype(int)
    rows = np.rint(np.clip(np.nan_to_num(v), 0, height - 1)).astype(int)
    there = before.depth[rows, columns]
    visible = np.abs(there - depth) < RELATIVE_DEPTH * depth + ABSOLUTE_DEPTH_M
    pixels = {
        "off-map": ~covered,
        "moving": covered & foreground,
        "entering": covered & ~foreground & ~inside,
        "disoccluded": covered & ~foreground & inside & ~visible,
    }
    kinds = np.zeros(by_macroblock(covered).shape, np.int8)
    for name in reversed(PRECEDENCE):
        kinds[by_macroblock(pixels[name]) >= SHARE] = KINDS.index(name)
    return kinds


def _in_previous_view(previous: Camera, now: FieldView) -> tuple[F64, F64, F64]:
    """Return where the surface of each pixel lies in the previous view: (u, v) in pixels, depth."""
    k = now.camera.intrinsics
    height, width = now.depth.shape
    rays = np.stack(
        [
            *np.meshgrid(
                (np.arange(width) + 0.5 - k.cx_px) / k.fx_px,
                (np.arange(height) + 0.5 - k.cy_px) / k.fy_px,
            ),
            np.ones((height, width)),
        ],
        axis=-1,
    )
    points = rays * now.depth[..., None].astype(np.float64)
    previous_from_now = previous.cam_from_world().compose(now.camera.world_from_cam)
    rotation = np.array(previous_from_now.rotation_matrix())
    moved = points @ rotation.T + np.array(previous_from_now.translation_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = k.fx_px * moved[..., 0] / moved[..., 2] + k.cx_px - 0.5
        v = k.fy_px * moved[..., 1] / moved[..., 2] + k.cy_px - 0.5
    return u, v, moved[..., 2]


@dataclass(frozen=True)
class SplitClip:
    """A clip to look into; ``foregrounds`` bool [H, W] a frame, what is not in the field."""

    frames: Sequence[I420]
    rendered: RenderedClip
    foregrounds: Sequence[NDArray[np.bool_]]
    effort: str
    crf: float


def split_rows(clip: SplitClip) -> list[dict[str, Any]]:
    """Return for each kind its share of the macroblocks and of the slices' bytes, first frame not
    counted, and the bytes a frame."""
    areas, slices = np.zeros(len(KINDS)), np.zeros(len(KINDS))
    for area, share in _split_frames(clip):
        areas += area
        slices += share
    frames = len(clip.frames) - 1
    return [
        {
            "shows": kind,
            "area_percent": float(100 * areas[index] / areas.sum()),
            "slice_percent": float(100 * slices[index] / slices.sum()),
            "bytes_per_frame": float(slices[index] / frames),
        }
        for index, kind in enumerate(KINDS)
    ]


def _split_frames(clip: SplitClip) -> Iterator[tuple[F64, F64]]:
    """Yield macroblocks and slice bytes by kind for every frame but the first."""
    encoder = DeltaEncoder(CodecConfig(*clip.frames[0].size_px, effort=clip.effort, crf=clip.crf))
    state, rendered = encoder.start(1), clip.rendered
    for index, frame in enumerate(clip.frames):
        coding = _Coding(encoder, state, rendered.views[index])
        made = coding.of(frame)
        if index:
            kinds = macroblock_kinds(
                rendered.views[index - 1],
                rendered.views[index],
                rendered.covered[index],
                clip.foregrounds[index],
            )
            yield (
                np.bincount(kinds.ravel(), minlength=len(KINDS)).astype(np.float64),
                _slice_bytes(clip.frames[index], coding, made, kinds),
            )
        state = made.state


@dataclass(frozen=True)
class _Coding:
    """Everything a frame is coded with but the frame itself."""

    encoder: DeltaEncoder
    state: EncoderState
    view: FieldView

    def of(self, frame: I420, choice: FrameChoice | None = None) -> Encoded:
        return self.encoder.encode(self.state, frame, self.view, choice or FrameChoice())


def _slice_bytes(frame: I420, coding: _Coding, made: Encoded, kinds: NDArray[np.int8]) -> F64:
    packet = made.packet
    whole = len(packet.payload)
    spared = np.zeros(len(KINDS))
    if not packet.references:  # an I picture has no reference to show
        spared += np.bincount(kinds.ravel(), minlength=len(KINDS))
    else:
        prediction = prediction_of(packet, coding.view, coding.state.past)
        reference = prediction.picture(packet.references[-1])
        choice = FrameChoice(
            packet.references,
            photometric=packet.photometric,
            relight=packet.relit,
            light=packet.light,
        )
        for kind in np.unique(kinds):
            without = composed(reference, frame, kinds == kind)
            spared[kind] = max(0, whole - len(coding.of(without, choice).packet.payload))
    shares: F64 = spared * (whole / max(float(spared.sum()), 1.0))
    return shares


def run_compare(job: CompareJob, console: Console) -> dict[str, Any]:
    """Code every drive with every coder, write ``job.out`` and print the rows.

    Raises ``InvalidInput`` or ``DatasetError`` before anything is coded if an input is wrong, and
    ``InvalidInput`` after the ends of the curves if one cannot span the window.
    """
    comparisons = read_drive_comparisons(job)
    fields = dict.fromkeys(comparison.field for comparison in comparisons)
    store, made = CellStore(job.cells), provenance(list(fields))
    _announce(job, comparisons, store, console)
    if job.processes > 1:
        for _ in each_done(_code_here, _parts(job), job.processes):
            pass
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


PARTS = 4
"""Of the coders of a drive, each in a process that renders the drive anew, which takes seconds."""
JOB_BYTES = 2_000_000_000


def _parts(job: CompareJob) -> list[tuple[CompareJob, int]]:
    """Return every drive as often as its coders have parts, which are numbered from 1."""
    return [(one, part) for one in job.of_each_drive() for part in range(1, PARTS + 1)]


def _code_here(numbered: tuple[CompareJob, int]) -> None:
    _code_part(*numbered, Path.cwd(), partial(print, flush=True))


def code_on_ray(job: CompareJob, address: str, tell: Tell) -> None:
    """Code every drive with every coder as jobs of a Ray whose machines see the same folders.

    What they leave in ``job.cells`` is what ``run_compare`` then finds there. Processor times are
    not taken: it takes them, with the machine to itself. Raises ``RfedgeError`` naming the jobs
    that failed and why; what the others coded stays.
    """
    folder = Path.cwd()
    jobs = [
        Job(
            f"drive-{1 + number // PARTS}-part-{part}",
            partial(_code_part, one, part, folder),
            (),
            None,
            cores=1,
            memory_bytes=JOB_BYTES,
        )
        for number, (one, part) in enumerate(_parts(job))
    ]
    run_jobs(jobs, tell, address)


def _code_part(job: CompareJob, part: int, folder: Path, tell: Tell) -> None:
    with chdir(folder):  # workers run in folders of their own
        (comparison,) = read_drive_comparisons(job)
        store, clip = CellStore(job.cells), comparison.clip
        spanning = {coder.name for coder in comparison.compared}
        every = list({coder.name: coder for coder in comparison.coders}.values())
        for coder in every[part - 1 :: PARTS]:
            window = job.windows_db[0] if coder.name in spanning else None
            perform(clip, coder, store, window_db=window, timed=False)
            tell(f"{clip.scene} {clip.rate_hz:g} Hz: {coder.name}")


def _announce(
    job: CompareJob,
    comparisons: Sequence[DriveComparison],
    store: CellStore,
    console: Console,
) -> None:
    left_s = sum(seconds_left(c.clip, c.coders, store) for c in comparisons) / job.processes
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
